"""The simulated arm with its power stages: what the drives' current targets do to the encoders.

M(q) qdd + N(q, qd) + friction = C' G i - offset, with M holding the rotors C' diag(Ia) C, motor speeds C qd, viscous
and exact Coulomb friction on joints and motors, brakes on the motors. One substep drifts half a step, kicks with the
forces at the middle and drifts again (leapfrog): second order, no fictitious damping. Viscous friction is taken by
the trapezoidal rule and dry friction at the end of the step, so no friction is too steep for the step.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emulator import current_loop
from emulator.current_loop import advance_current
from emulator.friction import factor, rub, solve
from emulator.kernels import Floats, Ints, compiled, composite_inertia, newton_euler, place
from protocols.errors import ConfigError
from protocols.robot import Robot, geometry

CSP, CST = 8, 10  # modes of operation 0x6060 (CiA 402); any other is power off with the brake engaged
BRAKE_FACTOR = 2.0  # holding torque of a brake over the largest joint torque; what catalogues offer is 1.5 to 2.5
AMBIENT_C = 22.0
RATED_RISE_K = 70.0  # temperature rise of a winding in the long run at rated current, insulation class F at half load
THERMAL_TIME_CONSTANT_S = 1200.0  # motors of 100 to 400 W: 15 to 30 min


class Body(NamedTuple):
    """Constants of the mechanics, arrays as in `protocols.robot.Geometry` and `emulator.kernels`.

    Attributes:
        rotor: C' diag(Ia) C, shape (J, J) [kg·m²].
        viscous: diag(Fv) + C' diag(Fvm) C, shape (J, J) [N·m·s/rad].
        dry_rows: Speeds with dry friction, shape (K, J).
        dry_Nm: Coulomb friction of each row, shape (K,).
        brake_row: Row on which the brake of each motor acts, shape (J,).
        brake_Nm: Holding torque, joint side, shape (J,).
    """

    R0: Floats
    p0: Floats
    prismatic: Ints
    gravity: Floats
    link: Floats
    rotor: Floats
    viscous: Floats
    offset_Nm: Floats
    dry_rows: Floats
    dry_Nm: Floats
    brake_row: Ints
    brake_Nm: Floats


class Power(NamedTuple):
    """Constants of the drives, one entry or row per axis.

    Attributes:
        C: Motor speed (joint side) = C qd.
        gain: Torque per ampere on the joint side, with the sign of the gear [N·m/A].
        emf: Back-EMF per speed of the motor on the joint side, signed [V·s/rad].
        stiffness, damping: CSP law, current per position and speed error, signed [A/rad], [A·s/rad].
        linear, limited, kr, integration: Of `current_loop.advance_current`.
    """

    C: Floats
    gain: Floats
    emf: Floats
    max_A: Floats
    bus_V: Floats
    stiffness: Floats
    damping: Floats
    linear: Floats
    limited: Floats
    kr: Floats
    integration: Floats


class State(NamedTuple):
    """What changes, in place.

    Attributes:
        q, qd, qdd: Joints; qdd is the mean over the last substep, which predicts the next.
        impulse: Dry friction of the last substep, shape (K,) [N·m·s].
        current_A, integrator_V: Current loops.
        target_rad: Position target at the end of the last period, motor angle on the joint side.
        following: 1 where the last period was in CSP.
        mean_A, heating_A2: Measured mean and true mean square of the current over the last period.
    """

    q: Floats
    qd: Floats
    qdd: Floats
    impulse: Floats
    current_A: Floats
    integrator_V: Floats
    target_rad: Floats
    following: Ints
    mean_A: Floats
    heating_A2: Floats


@compiled
def _currents(
    power: Power,
    state: State,
    mode: Ints,
    target_rad: Floats,
    target_A: Floats,
    noise_A: Floats,
    speed: Floats,
    share: float,
    mean: Floats,
) -> None:
    """One substep of all current loops: fills mean, shape (J,) [A].

    Args:
        speed: Joint speeds in the middle of the substep.
        share: Of the way from the last position target to this one.
    """
    J = len(mode)
    for j in range(J):
        mean[j] = 0.0
        if mode[j] not in (CSP, CST):
            continue
        angle, turning = 0.0, 0.0
        for i in range(J):
            angle += power.C[j, i] * state.q[i]
            turning += power.C[j, i] * speed[i]
        reference = target_A[j]
        if mode[j] == CSP:
            wanted = state.target_rad[j] + share * (target_rad[j] - state.target_rad[j])
            reference = power.stiffness[j] * (wanted - angle) - power.damping[j] * turning
        reference = min(max(reference, -power.max_A[j]), power.max_A[j])
        state.current_A[j], state.integrator_V[j], mean[j] = advance_current(
            power.linear[j],
            power.limited[j],
            power.kr[j],
            power.integration[j],
            power.bus_V[j],
            state.current_A[j],
            state.integrator_V[j],
            reference - noise_A[j],
            power.emf[j] * turning,
        )


@compiled
def _advance(
    body: Body,
    power: Power,
    state: State,
    mode: Ints,
    target_rad: Floats,
    target_A: Floats,
    noise_A: Floats,
    h: float,
) -> bool:
    """All substeps of one period; False where the mass matrix is not positive definite.

    Args:
        target_rad: Motor angles on the joint side, shape (J,).
        noise_A: Of the current sensors, shape (substeps, J).
    """
    substeps, J = noise_A.shape
    K = len(body.dry_Nm)
    R, p, f, n = np.empty((J, 3, 3)), np.empty((J, 3)), np.empty((J, 3)), np.empty((J, 3))
    M, whole, X = np.empty((J, J)), np.empty((J, 10)), np.empty((K, J))
    middle, speed, rest = np.empty(J), np.empty(J), np.zeros(J)
    torque, kick, mean = np.empty(J), np.empty(J), np.empty(J)
    q, qd, qdd = state.q, state.qd, state.qdd
    bound = h * body.dry_Nm
    for j in range(J):
        state.mean_A[j] = 0.0
        state.heating_A2[j] = 0.0
        if mode[j] not in (CSP, CST):
            bound[body.brake_row[j]] += h * body.brake_Nm[j]
            state.current_A[j] = 0.0
            state.integrator_V[j] = 0.0
        if mode[j] == CSP and not state.following[j]:
            state.target_rad[j] = target_rad[j]  # nothing to interpolate from
    for step in range(substeps):
        for j in range(J):
            middle[j] = q[j] + h / 2 * qd[j]
            speed[j] = qd[j] + h / 2 * qdd[j]
        place(body.R0, body.p0, body.prismatic, middle, R, p)
        newton_euler(R, p, body.prismatic, body.gravity, body.link, speed, rest, torque, f, n)
        composite_inertia(R, p, body.prismatic, body.link, M, whole)

        for j in range(J):
            kick[j] = -torque[j] - body.offset_Nm[j]
            for i in range(J):
                kick[j] -= body.viscous[j, i] * qd[i]
                M[j, i] += body.rotor[j, i] + h / 2 * body.viscous[j, i]
        share = (step + 1) / substeps
        _currents(power, state, mode, target_rad, target_A, noise_A[step], speed, share, mean)
        for j in range(J):
            state.mean_A[j] += (mean[j] + noise_A[step, j]) / substeps
            state.heating_A2[j] += mean[j] ** 2 / substeps
            for i in range(J):
                kick[i] += power.C[j, i] * power.gain[j] * mean[j]

        if not factor(M):
            return False
        solve(M, kick)
        for j in range(J):
            speed[j] = qd[j] + h * kick[j]
        rub(M, body.dry_rows, bound, speed, state.impulse, X)
        for j in range(J):
            qdd[j] = (speed[j] - qd[j]) / h
            qd[j] = speed[j]
            q[j] = middle[j] + h / 2 * qd[j]
    for j in range(J):
        state.target_rad[j] = target_rad[j]
        state.following[j] = mode[j] == CSP
    return True


class Plant:
    """Arm, brakes, current loops, encoders and current sensors of one rig; advances one sync period at a time.

    Attributes:
        q, qd: Joint positions and speeds at the end of the last period, shape (J,) [rad, rad/s].
        current_gains: KR [V/A] and TN [s] of each axis, shape (J, 2).
        motor_temperature_C: Windings, shape (J,).
        ambient_C: Where the windings start and cool to.
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
    ) -> None:
        """At rest at `start_rad`, by default the joint zero or the limit next to it.

        Args:
            robot: The truth.
            current_noise_A: Standard deviation of a period's mean current, shape (J,).
            encoder_noise_rad: Standard deviation of an encoder reading on the joint side, shape (J,).
            substep_Hz: At least this many substeps per second.
        """
        J = robot.joints
        drives = [joint.drive for joint in robot.joint]
        self._robot = robot
        self._period_s = period_s
        self._substeps = max(1, int(np.ceil(period_s * substep_Hz - 1e-9)))
        self._h_s = period_s / self._substeps
        self._rng = rng
        self._current_noise_A = np.broadcast_to(current_noise_A, J) * np.sqrt(self._substeps)
        self._counts_per_rad = robot.counts_per_rad()
        self._encoder_noise = np.broadcast_to(encoder_noise_rad, J) * np.abs(self._counts_per_rad)
        self._body = _body(robot)
        self._power = _power(robot, self._h_s)
        low = np.array([joint.position_min_rad for joint in robot.joint])
        high = np.array([joint.position_max_rad for joint in robot.joint])
        q = np.clip(np.zeros(J), low, high) if start_rad is None else np.array(start_rad, dtype=float)
        self._state = State(
            q=q,
            qd=np.zeros(J),
            qdd=np.zeros(J),
            impulse=np.zeros(len(self._body.dry_Nm)),
            current_A=np.zeros(J),
            integrator_V=np.zeros(J),
            target_rad=np.zeros(J),
            following=np.zeros(J, dtype=np.int64),
            mean_A=np.zeros(J),
            heating_A2=np.zeros(J),
        )
        self.q, self.qd = self._state.q, self._state.qd
        self.current_gains = np.array([current_loop.gains(drive) for drive in drives])
        for j in range(J):
            self.set_current_gains(j, *self.current_gains[j])
        self._rated_A = np.array([drive.rated_current_A for drive in drives])
        self.ambient_C = ambient_C
        self.motor_temperature_C = np.full(J, ambient_C)
        self._counts = self._read_encoders(np.zeros(J))
        self._velocity = np.zeros(J, dtype=np.int64)

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
        noise_A = draws[:-1] * self._current_noise_A
        target_rad = target_counts / self._counts_per_rad
        if not _advance(self._body, self._power, self._state, mode, target_rad, target_current_A, noise_A, self._h_s):
            raise ConfigError(
                f"{self._robot.name}: the mass matrix is not positive definite at"
                f" q = {np.array2string(self.q, precision=3)} rad. Use parameters that a physical arm can have."
            )
        rise = self.ambient_C + RATED_RISE_K * self._state.heating_A2 / self._rated_A**2 - self.motor_temperature_C
        self.motor_temperature_C += rise * (self._period_s / THERMAL_TIME_CONSTANT_S)
        before = self._counts
        self._counts = self._read_encoders(draws[-1])
        self._velocity = np.rint((self._counts - before) / self._period_s).astype(np.int64)

    def measure(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
        """Latched at the end of `advance`: encoder counts, counts/s (difference of two latches), mean current [A]."""
        return self._counts, self._velocity, self._state.mean_A.copy()

    def _read_encoders(self, draw: Floats) -> NDArray[np.int64]:
        exact = (self._power.C @ self.q) * self._counts_per_rad
        return np.rint(exact + draw * self._encoder_noise).astype(np.int64)


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


def _power(robot: Robot, h_s: float) -> Power:
    """An axis without a control law has no CSP: its gains are 0 and it makes no torque in that mode."""
    drives = [joint.drive for joint in robot.joint]
    J = robot.joints
    sign = np.sign([drive.gear_ratio for drive in drives])
    gain = robot.drive_gains() * sign
    law = np.zeros((J, 2))
    for j, joint in enumerate(robot.joint):
        if joint.control is not None:  # Janot et al. 2014, eq. (19), (21)
            w, z = joint.control.natural_frequency_rad_s, joint.control.damping
            law[j] = np.array([w**2, 2 * z * w]) * joint.control.inertia_kgm2 / gain[j]
    return Power(
        C=robot.coupling_matrix(),
        gain=gain,
        emf=np.array([drive.torque_constant_Nm_A * drive.gear_ratio for drive in drives]),
        max_A=np.array([drive.max_current_A for drive in drives]),
        bus_V=np.array([drive.bus_voltage_V for drive in drives]),
        stiffness=law[:, 0].copy(),
        damping=law[:, 1].copy(),
        linear=np.empty((J, 3, 4)),
        limited=np.array([current_loop.saturated(drive, h_s) for drive in drives]),
        kr=np.empty(J),
        integration=np.empty(J),
    )
