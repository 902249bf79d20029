"""The simulated rig behind the drives: arm, brakes, current loops, encoders and current sensors."""

import numpy as np
from numpy.typing import NDArray

from emulator import current_loop
from emulator.arm import Body, Power, State, advance_period
from emulator.effects.build import initial, physics
from emulator.effects.period import Memory, Physics, advance_with_effects
from emulator.effects.present import present_in, true_gain, with_static
from emulator.kernels import Floats, Ints
from protocols.dictionary import current_loop_gains
from protocols.errors import ConfigError
from protocols.robot import Robot, geometry

BRAKE_FACTOR = 2.0  # holding torque of a brake over the largest joint torque; what catalogues offer is 1.5 to 2.5
AMBIENT_C = 22.0
RATED_RISE_K = 70.0  # temperature rise of a winding in the long run at rated current, insulation class F at half load
THERMAL_TIME_CONSTANT_S = 1200.0  # motors of 100 to 400 W: 15 to 30 min


class Plant:
    """The machine of one rig; advances one sync period at a time.

    Attributes:
        q, qd: Joint positions and speeds at the end of the last period, shape (J,) [rad, rad/s].
        current_gains: KR [V/A] and TN [s] of each axis, shape (J, 2).
        motor_temperature_C: What the cell's sensors see, shape (J,): the windings; where friction depends on
            temperature, the lubricant, with the sensor's lag.
        ambient_C: Where temperatures start and go back to.
    """

    def __init__(
        self,
        robot: Robot,
        period_s: float,
        rng: np.random.Generator,
        current_noise_A: Floats,
        encoder_noise_rad: Floats,
        *,
        start_rad: Floats | None = None,
        substep_Hz: float = 10_000.0,
        ambient_C: float = AMBIENT_C,
        extended: bool = False,
    ) -> None:
        """At rest at `start_rad`, by default the joint zero or the limit next to it.

        Args:
            robot: The truth, with its effects.
            current_noise_A: Standard deviation of a period's mean current, shape (J,).
            encoder_noise_rad: Standard deviation of an encoder reading on the joint side, shape (J,).
            substep_Hz: At least this many substeps per second.
            extended: Use the extended physics even where no effect needs it.

        Raises:
            ConfigError: An effect that this arm cannot have.
        """
        J = robot.joints
        present = present_in(robot)
        self._robot = robot
        self._period_s = period_s
        self._substeps = max(1, int(np.ceil(period_s * substep_Hz - 1e-9)))
        self._h_s = period_s / self._substeps
        self._rng = rng
        self._trace_rng = rng.spawn(1)[0]
        self.ambient_C = ambient_C
        self._body = _body(with_static(present))
        power = _power(robot, period_s, self._substeps, current_noise_A, encoder_noise_rad)
        self._power = power._replace(gain=true_gain(power.gain, present), emf=true_gain(power.emf, present))
        self.current_gains = np.array([current_loop_gains(joint.drive) for joint in robot.joint])
        for j in range(J):
            self.set_current_gains(j, *self.current_gains[j])
        low = np.array([joint.position_min_rad for joint in robot.joint])
        high = np.array([joint.position_max_rad for joint in robot.joint])
        q = np.clip(np.zeros(J), low, high) if start_rad is None else np.array(start_rad, dtype=float)
        self._state = _at_rest(q, self._body, ambient_C)
        self.motor_temperature_C = self._state.temperature_C
        self._extended: tuple[Physics, Memory] | None = None
        if present.is_dynamic or extended:
            constants = physics(present, self._body, period_s, self._substeps, q)
            self._state, memory = initial(constants, self._power, q, self._substeps, ambient_C)
            self._extended = constants, memory
            self.motor_temperature_C = memory.warm.shown_C
        self.q, self.qd = self._state.q, self._state.qd
        self._state.counts[:] = robot.motor_counts(q)
        self._counts = np.rint(self._state.counts).astype(np.int64)
        self._before = self._counts
        self.keep_trace(wanted=False)

    def set_current_gains(self, j: int, kr: float, tn_s: float) -> None:
        """PI gains of the current loop of axis j.

        Args:
            kr: Proportional gain [V/A], above 0.
            tn_s: Integral time [s], above 0.

        Raises:
            ConfigError: A gain is not positive.
        """
        if not (kr > 0 and tn_s > 0):
            raise ConfigError(
                f"{self._robot.joint_names[j]}: current loop gains KR = {kr:g} V/A and TN = {tn_s:g} s must be above 0."
            )
        self.current_gains[j] = kr, tn_s
        self._power.kr[j] = kr
        self._power.integration[j] = kr * self._h_s / tn_s
        self._power.linear[j] = current_loop.closed_loop(self._robot.joint[j].drive, kr, tn_s, self._h_s)

    def set_current_limit(self, j: int, limit_A: float) -> None:
        """Saturation of the current loop's reference on axis j, in every mode."""
        self._power.max_A[j] = limit_A

    def compiled(self) -> tuple[Physics, Power, State, Memory] | None:
        """What the compiled physics works on, for loops that leave Python; None where it is not extended."""
        return None if self._extended is None else (self._extended[0], self._power, self._state, self._extended[1])

    def warm_to(self, temperature_C: Floats) -> None:
        """Windings, lubricants and sensors of all axes as after long work, shape (J,)."""
        self._state.temperature_C[:] = temperature_C
        self.motor_temperature_C[:] = temperature_C
        if self._extended is not None:
            self._extended[1].warm.lubricant_C[:] = temperature_C

    def advance(self, mode: Ints, target_counts: Floats, target_current_A: Floats) -> None:
        """One sync period.

        Args:
            mode: Per axis 8 (CSP), 10 (CST) or 0 (power off, brake engaged).
            target_counts: Motor position at the end of the period, for CSP; reached on a straight line.
            target_current_A: Held over the period, for CST. Both are limited to the drive's maximum current.

        Raises:
            ConfigError: The mass matrix is not positive definite: the robot file describes no physical arm.
        """
        draws = self._rng.standard_normal((self._substeps + 1, len(self.q)))
        aims = mode, target_counts, target_current_A, draws, self.ambient_C, self._h_s, self._trace
        if self._extended is None:
            sound = advance_period(self._body, self._power, self._state, *aims)
        else:
            constants, memory = self._extended
            sound = advance_with_effects(constants, self._power, self._state, memory, *aims)
        if not sound:
            raise ConfigError(
                f"{self._robot.name}: the mass matrix is not positive definite at"
                f" q = {np.array2string(self.q, precision=3)} rad. Use parameters that a physical arm can have."
            )
        self._before = self._counts
        self._counts = np.rint(self._state.counts).astype(np.int64)

    @property
    def substep_s(self) -> float:
        """Spacing of `trace`."""
        return self._h_s

    def keep_trace(self, *, wanted: bool) -> None:
        """Have `advance` remember its substeps; nothing else depends on it."""
        self._trace = np.empty((self._substeps if wanted else 0, 2, len(self.q)))

    def trace(self) -> tuple[NDArray[np.int64], Floats]:
        """Encoder counts and mean currents [A] after each substep of the last period, shape (substeps, J). Noise of the
        encoders comes from a generator of its own, so that recording changes nothing that is recorded otherwise."""
        noise = self._trace_rng.standard_normal(self._trace[:, 0].shape) * self._power.noise_counts
        return np.rint(self._trace[:, 0] + noise).astype(np.int64), self._trace[:, 1]

    def measure(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
        """Latched at the end of `advance`: encoder counts, counts/s (difference of two latches), mean current [A]."""
        velocity = np.rint((self._counts - self._before) / self._period_s).astype(np.int64)
        return self._counts, velocity, self._state.mean_A.copy()


def _at_rest(q: Floats, body: Body, ambient_C: float) -> State:
    J = len(q)
    return State(
        q=q,
        qd=np.zeros(J),
        qdd=np.zeros(J),
        impulse=np.zeros(len(body.dry_Nm)),
        current_A=np.zeros(J),
        integrator_V=np.zeros(J),
        target=np.zeros(J),
        following=np.zeros(J, dtype=np.int64),
        mean_A=np.zeros(J),
        counts=np.zeros(J),
        temperature_C=np.full(J, ambient_C),
    )


def _body(robot: Robot) -> Body:
    chain = geometry(robot)
    J = robot.joints
    C = robot.coupling_matrix()
    parameters = [joint.parameters for joint in robot.joint]
    motor_viscous = np.array([p.motor_viscous_Nms_rad for p in parameters])
    motor_dry = np.array([p.motor_coulomb_Nm for p in parameters])
    rows, dry = list(np.eye(J)), [p.coulomb_Nm for p in parameters]
    brake_row = np.arange(J)
    for j in range(J):
        if np.array_equal(C[j], np.eye(J)[j]):  # motor and joint turn as one: one row holds both frictions
            dry[j] += motor_dry[j]
        else:
            brake_row[j] = len(rows)
            rows.append(C[j])
            dry.append(motor_dry[j])
    return Body(
        R0=chain.R0,
        p0=chain.p0,
        prismatic=chain.prismatic,
        gravity=chain.gravity,
        link=np.array([p.inertial() for p in parameters]),
        rotor=C.T @ np.diag([p.rotor_inertia_kgm2 for p in parameters]) @ C,
        viscous=np.diag([p.viscous_Nms_rad for p in parameters]) + C.T @ np.diag(motor_viscous) @ C,
        offset_Nm=np.array([p.offset_Nm for p in parameters]),
        dry_rows=np.array(rows),
        dry_Nm=np.array(dry),
        brake_row=brake_row,
        brake_Nm=BRAKE_FACTOR * np.array([joint.torque_max_Nm for joint in robot.joint]),
    )


def _power(robot: Robot, period_s: float, substeps: int, current_noise_A: Floats, encoder_noise_rad: Floats) -> Power:
    """An axis without a control law has no CSP: its gains are 0 and it makes no torque in that mode."""
    drives = [joint.drive for joint in robot.joint]
    J = robot.joints
    gain = robot.drive_gains() * np.sign([drive.gear_ratio for drive in drives])
    law = np.zeros((J, 2))
    for j, joint in enumerate(robot.joint):
        if joint.control is not None:  # Janot et al. 2014, eq. (19), (21)
            w, z = joint.control.natural_frequency_rad_s, joint.control.damping
            law[j] = np.array([w**2, 2 * z * w]) * joint.control.inertia_kgm2 / gain[j]
    cooling = period_s / THERMAL_TIME_CONSTANT_S
    return Power(
        C=robot.coupling_matrix(),
        gain=gain,
        emf=np.array([drive.torque_constant_Nm_A * drive.gear_ratio for drive in drives]),
        max_A=np.array([drive.max_current_A for drive in drives]),
        bus_V=np.array([drive.bus_voltage_V for drive in drives]),
        stiffness=law[:, 0].copy(),
        damping=law[:, 1].copy(),
        linear=np.empty((J, 3, 4)),
        limited=np.array([current_loop.saturated(drive, period_s / substeps) for drive in drives]),
        kr=np.empty(J),
        integration=np.empty(J),
        noise_A=np.broadcast_to(current_noise_A, J) * np.sqrt(substeps),
        counts_per_rad=robot.counts_per_rad(),
        noise_counts=np.broadcast_to(encoder_noise_rad, J) * np.abs(robot.counts_per_rad()),
        heating=RATED_RISE_K * cooling / np.array([drive.rated_current_A for drive in drives]) ** 2,
        cooling=cooling,
    )
