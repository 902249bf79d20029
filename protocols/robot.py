"""`robot.toml`: geometry, drives, control law and parameters of one arm.

Geometry is modified Denavit-Hartenberg in Khalil's convention,
T(j-1, j) = Rx(alpha) Tx(d) Rz(theta0 + q) Tz(r) for a revolute joint and Rz(theta0) Tz(r + q) for a prismatic
one, or the serial chain of a URDF file. For prismatic joints read m for rad and N for N·m in every key.
"""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from protocols import config
from protocols.effects import Effect
from protocols.errors import ConfigError

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Vector3 = tuple[float, float, float]
Vector6 = tuple[float, float, float, float, float, float]

INERTIAL = ("m", "mx", "my", "mz", "xx", "xy", "xz", "yy", "yz", "zz")  # order of a link's ten parameters


class Drive(config.Table, frozen=True, kw_only=True):
    """Motor, gear and power stage of one axis; what the CiA 402 device of that axis is built from.

    Attributes:
        gear_ratio: Motor angle per joint angle, with its sign [rad/rad, or rad/m].
        drive_gain_Nm_A: Joint torque per ampere, the `g_tau` of Janot et al. 2014, eq. (3), always positive.
        rated_current_A: What 1000 per mille mean in 0x6071 and 0x6078 (object 0x6075).
        max_current_A: Saturation of the current loop.
        encoder_counts_per_rev: Counts per motor revolution.
        current_bandwidth_Hz: Closed current loop, -3 dB.
        current_delay_s: Age of the current value in a TPDO: 0x6078 is the mean over the last SYNC period, so its
            time is half a period before the SYNC that latched the position.
        resistance_Ohm, inductance_H, bus_voltage_V: Winding and supply seen by the current loop.
    """

    gear_ratio: float
    drive_gain_Nm_A: Positive
    rated_current_A: Positive
    max_current_A: Positive
    encoder_counts_per_rev: Annotated[int, Meta(gt=0)] = 131072
    current_bandwidth_Hz: Positive = 600.0
    current_delay_s: NotNegative = 0.0005
    resistance_Ohm: Positive = 1.0
    inductance_H: Positive = 0.002
    bus_voltage_V: Positive = 320.0

    @property
    def counts_per_rad(self) -> float:
        """Encoder counts per joint radian (or metre), signed."""
        return self.encoder_counts_per_rev * self.gear_ratio / (2 * np.pi)

    @property
    def torque_constant_Nm_A(self) -> float:
        """Motor torque per ampere = back-EMF constant [N·m/A = V·s/rad]."""
        return self.drive_gain_Nm_A / abs(self.gear_ratio)


class Control(config.Table, frozen=True, kw_only=True):
    """PD law of Janot et al. 2014, eq. (19)-(21): v = (kp kv (qr - q) - kv dq) J / g, with kp = w/(2 z), kv = 2 z w.

    Attributes:
        natural_frequency_rad_s: Desired closed-loop natural frequency w.
        damping: Desired damping z.
        inertia_kgm2: A-priori inertia J of the axis.
    """

    natural_frequency_rad_s: Positive
    damping: Positive = 1.0
    inertia_kgm2: Positive


class Parameters(config.Table, frozen=True, kw_only=True):
    """Dynamic parameters of one link and its axis, inertia at the origin of the link frame.

    Attributes:
        mass_kg: m.
        first_moment_kgm: (mx, my, mz) = m times the centre of mass.
        inertia_kgm2: (xx, xy, xz, yy, yz, zz) about the frame origin.
        rotor_inertia_kgm2: Ia of the motor, referred to the joint side; moves with the motor's speed.
        viscous_Nms_rad, coulomb_Nm: Friction on the joint's speed.
        motor_viscous_Nms_rad, motor_coulomb_Nm: Friction on the motor's speed (row j of C dq), joint side.
            Differs from the joint's only where the coupling matrix does.
        offset_Nm: Constant torque (current offset, asymmetry of friction).
    """

    mass_kg: float = 0.0
    first_moment_kgm: Vector3 = (0.0, 0.0, 0.0)
    inertia_kgm2: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    rotor_inertia_kgm2: float = 0.0
    viscous_Nms_rad: float = 0.0
    coulomb_Nm: float = 0.0
    motor_viscous_Nms_rad: float = 0.0
    motor_coulomb_Nm: float = 0.0
    offset_Nm: float = 0.0

    def inertial(self) -> NDArray[np.float64]:
        """The ten parameters in the order of `INERTIAL`, shape (10,)."""
        return np.array([self.mass_kg, *self.first_moment_kgm, *self.inertia_kgm2])


class Joint(config.Table, frozen=True, kw_only=True):
    """One axis: where it is, what it may do, what drives it.

    Attributes:
        placement: Frame j in frame j-1 at q = 0 in place of the MDH row: three rows of the rotation, then the origin
            [m]. Written when a URDF file is loaded.
        sigma: 1-sigma of the a-priori parameters.
    """

    name: str
    kind: Literal["revolute", "prismatic"] = "revolute"
    alpha_rad: float = 0.0
    d_m: float = 0.0
    theta0_rad: float = 0.0
    r_m: float = 0.0
    placement: tuple[Vector3, Vector3, Vector3, Vector3] | None = None
    position_min_rad: float
    position_max_rad: float
    velocity_max_rad_s: Positive
    torque_max_Nm: Positive
    drive: Drive
    control: Control | None = None
    parameters: Parameters = msgspec.field(default_factory=Parameters)
    sigma: Parameters | None = None

    def __post_init__(self) -> None:
        if not self.position_min_rad < self.position_max_rad:
            raise ValueError(
                f"{self.name}: position_min_rad = {self.position_min_rad:g} must be below"
                f" position_max_rad = {self.position_max_rad:g}"
            )
        if self.drive.gear_ratio == 0:
            raise ValueError(f"{self.name}: gear_ratio must not be 0")


class EffectEntry(config.Table, frozen=True, kw_only=True):
    """One physical effect beyond rigid bodies with viscous and Coulomb friction.

    Attributes:
        effect: Key of the vocabulary.
        joint: Name of the axis; empty where the effect belongs to the whole arm.
        parameters: Values by name, units in the name.
    """

    effect: Effect
    joint: str = ""
    parameters: dict[str, float] = msgspec.field(default_factory=dict)


class Robot(config.Table, frozen=True, kw_only=True):
    """One arm.

    Attributes:
        name: Shown everywhere.
        joint: Axes from the base to the tool.
        gravity_m_s2: In the base frame.
        urdf: Path of a URDF file, relative to the robot file: its geometry replaces the joints' MDH rows, and its
            inertial parameters those of links without a mass. `load` writes them into the joints.
        coupling: Rows of C with motor speed (joint side) = C dq; identity where left out.
        effect: Physics found by `explain`, loaded by the emulator.
    """

    name: str
    gravity_m_s2: Vector3 = (0.0, 0.0, -9.81)
    urdf: str | None = None
    coupling: list[list[float]] | None = None
    joint: list[Joint]
    effect: list[EffectEntry] = []

    def __post_init__(self) -> None:
        n = len(self.joint)
        if not 1 <= n <= 12:
            raise ValueError(f"{n} joints; serial chains of 1 to 12 are supported")
        names = [j.name for j in self.joint]
        if len(set(names)) != n:
            raise ValueError(f"joint names must differ, not {', '.join(names)}")
        if self.coupling is not None:
            if [len(row) for row in self.coupling] != [n] * n:
                raise ValueError(f"coupling must have {n} rows of {n} numbers")
            if abs(np.linalg.det(np.array(self.coupling))) < 1e-9:
                raise ValueError("coupling is singular: motor angles would not determine joint angles")

    @property
    def joints(self) -> int:
        """Number of axes J."""
        return len(self.joint)

    @property
    def joint_names(self) -> list[str]:
        return [j.name for j in self.joint]

    def coupling_matrix(self) -> NDArray[np.float64]:
        """C with motor speed (joint side) = C dq, shape (J, J)."""
        return np.eye(self.joints) if self.coupling is None else np.array(self.coupling, dtype=float)

    def drive_gains(self) -> NDArray[np.float64]:
        """G_tau, joint torque per ampere, shape (J,) [N·m/A]."""
        return np.array([j.drive.drive_gain_Nm_A for j in self.joint])

    def counts_per_rad(self) -> NDArray[np.float64]:
        """Encoder counts per joint-side motor radian, signed, shape (J,)."""
        return np.array([j.drive.counts_per_rad for j in self.joint])

    def joint_position(self, counts: NDArray[np.floating] | NDArray[np.integer]) -> NDArray[np.float64]:
        """Joint positions of encoder counts: q = inv(C) counts / counts_per_rad, shapes (..., J) [rad]."""
        motor = np.asarray(counts, dtype=float) / self.counts_per_rad()
        return motor @ np.linalg.inv(self.coupling_matrix()).T

    def motor_counts(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Encoder counts of joint positions, not rounded: inverse of `joint_position`, shapes (..., J)."""
        return (q @ self.coupling_matrix().T) * self.counts_per_rad()

    def joint_torque(self, current_A: NDArray[np.float64]) -> NDArray[np.float64]:
        """Joint torques of drive currents: tau = C' G i, with the sign of the gear, shapes (..., J) [N·m]."""
        signed = self.drive_gains() * np.sign([j.drive.gear_ratio for j in self.joint])
        return (current_A * signed) @ self.coupling_matrix()

    def drive_current(self, tau_Nm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Drive currents that give joint torques: inverse of `joint_torque`, shapes (..., J) [A]."""
        signed = self.drive_gains() * np.sign([j.drive.gear_ratio for j in self.joint])
        return (tau_Nm @ np.linalg.inv(self.coupling_matrix())) / signed


class Geometry(msgspec.Struct, frozen=True):
    """The chain as the kernels want it: frame j in frame j-1 is (R0[j], p0[j]), then the joint moves about or
    along its own z.

    Attributes:
        R0: shape (J, 3, 3).
        p0: shape (J, 3) [m].
        prismatic: shape (J,), 1 where the joint is prismatic.
        gravity: shape (3,), base frame [m/s²].
    """

    R0: NDArray[np.float64]
    p0: NDArray[np.float64]
    prismatic: NDArray[np.int64]
    gravity: NDArray[np.float64]


def geometry(robot: Robot) -> Geometry:
    """Constant placements of the MDH rows: Rz(theta0 + q) Tz(r) = Rz(theta0) Tz(r) Rz(q), so q stays last.

    Raises:
        ConfigError: The robot names a URDF file; `load` resolves that.
    """
    if robot.urdf is not None:
        raise ConfigError(f"{robot.name}: geometry from the URDF file {robot.urdf} is not resolved; use load().")
    alpha = np.array([j.alpha_rad for j in robot.joint])
    theta = np.array([j.theta0_rad for j in robot.joint])
    d = np.array([j.d_m for j in robot.joint])
    r = np.array([j.r_m for j in robot.joint])
    ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
    zero = np.zeros_like(ca)
    R0 = np.array([[ct, -st, zero], [ca * st, ca * ct, -sa], [sa * st, sa * ct, ca]]).transpose(2, 0, 1)
    p0 = np.array([d, -sa * r, ca * r]).T
    for j, joint in enumerate(robot.joint):
        if joint.placement is not None:
            R0[j], p0[j] = joint.placement[:3], joint.placement[3]
    prismatic = np.array([int(j.kind == "prismatic") for j in robot.joint])
    return Geometry(np.ascontiguousarray(R0), np.ascontiguousarray(p0), prismatic, np.array(robot.gravity_m_s2))


def load(name: str, base: Path | None = None) -> Robot:
    """Robot of a file path or of a shipped robot's name.

    Raises:
        ConfigError: As `config.locate` and `config.read`; its URDF file is missing or does not fit.
    """
    path = config.locate(name, ".toml", base)
    robot = config.read(path, Robot)
    if robot.urdf is None:
        return robot
    from protocols.urdf import resolved  # needs pinocchio, which most robots do not

    return resolved(config.locate(robot.urdf, ".urdf", path.parent), robot)
