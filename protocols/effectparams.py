"""Parameters of the physical effects: names, units, ranges and what they mean, shared by files, flags and findings.

No equations: `emulator` simulates an effect and `ident` supposes it, each in a form of its own. What both sides agree
on is what the number says, so that a finding written to a robot file can be emulated. Torques, stiffnesses and angles
are on the joint side; for prismatic joints read m for rad, N for N·m and kg for kg·m² in every key.
"""

from typing import Literal

import msgspec

from protocols.effects import Effect

Scale = Literal["", "coulomb", "torque", "speed", "range", "inertia", "current"]
Place = Literal["joint", "arm", "either"]

_ANY = 1e9


class Parameter(msgspec.Struct, frozen=True):
    """One number of an effect.

    Attributes:
        name: Key in files and flags; its ending is the unit.
        unit: As shown.
        low, high: Range, ends included.
        default: Value where it is not given, in units of `of`.
        of: What the default is a multiple of: the axis' Coulomb friction, largest torque, largest speed, range,
            a-priori inertia or largest current; empty: it is the value itself.
        meaning: One line.
    """

    name: str
    unit: str
    low: float
    high: float
    default: float
    meaning: str
    of: Scale = ""


class Kind(msgspec.Struct, frozen=True):
    """What an effect is.

    Attributes:
        place: It belongs to one joint, to the whole arm, or to either (then no joint means all joints).
        sentence: What it is, to be shown.
        parameters: In the order of the table.
        repeatable: One joint may have several of it.
        least_joints: Arms with fewer cannot have it.
    """

    place: Place
    sentence: str
    parameters: tuple[Parameter, ...]
    repeatable: bool = False
    least_joints: int = 1

    @property
    def names(self) -> list[str]:
        return [p.name for p in self.parameters]


def _phase(name: str = "phase_rad") -> Parameter:
    return Parameter(name, "rad", -7.0, 7.0, 0.0, "phase at motor angle (or time) zero")


_AMPLITUDE = Parameter("amplitude_Nm", "N·m", -_ANY, _ANY, 0.3, "torque at the crest", "coulomb")
_STIFFNESS = Parameter(
    "stiffness_Nm_rad", "N·m/rad", 1e-3, 1e12, 9000.0, "torque per twist between motor and link", "inertia"
)
_DAMPING = Parameter("damping_Nms_rad", "N·m·s/rad", 0.0, _ANY, 5.0, "torque per speed of twist", "inertia")

_MOTOR_INERTIA = Parameter(
    "motor_inertia_kgm2",
    "kg·m²",
    0.0,
    _ANY,
    0.0,
    "inertia before the spring; taken from the link where it is more than the file's rotor. 0: the file's rotor, or a"
    " quarter of the link where the file has none",
)

EFFECT_KINDS: dict[Effect, Kind] = {
    "friction.stribeck": Kind(
        "joint",
        "friction at low speed above the Coulomb friction of fast motion",
        (
            Parameter("stiction_Nm", "N·m", 0.0, _ANY, 0.6, "friction at breakaway above Coulomb friction", "coulomb"),
            Parameter(
                "velocity_rad_s", "rad/s", 1e-9, 1e3, 0.02, "speed at which it has fallen to 37 % (1/e)", "speed"
            ),
            Parameter("exponent", "", 0.3, 3.0, 1.0, "how abruptly it falls with speed: 1 Tustin, 2 Gauss"),
            Parameter("lag_s", "s", 0.0, 0.1, 0.002, "time by which friction follows a change of speed"),
        ),
    ),
    "friction.asymmetric": Kind(
        "joint",
        "Coulomb friction that differs between the directions",
        (
            Parameter(
                "half_difference_Nm",
                "N·m",
                -_ANY,
                _ANY,
                0.3,
                "half of Coulomb friction in positive minus that in negative direction",
                "coulomb",
            ),
        ),
    ),
    "friction.viscous_nonlinear": Kind(
        "joint",
        "viscous friction that does not grow in proportion to speed",
        (
            Parameter("torque_Nm", "N·m", -_ANY, _ANY, 0.8, "added friction at velocity_rad_s", "coulomb"),
            Parameter("velocity_rad_s", "rad/s", 1e-9, 1e3, 0.4, "speed at which torque_Nm is meant", "speed"),
            Parameter("exponent", "", 0.1, 4.0, 2.0, "power of speed it grows with there; below 1: shear thinning"),
        ),
    ),
    "friction.load": Kind(
        "joint",
        "Coulomb friction that grows with the torque transmitted to the link",
        (
            Parameter("coefficient", "", 0.0, 1.0, 0.15, "friction per transmitted torque, N·m/N·m"),
            Parameter("preload_Nm", "N·m", 0.0, _ANY, 0.0, "transmitted torque below which it hardly grows"),
        ),
    ),
    "friction.temperature": Kind(
        "joint",
        "friction that changes with the temperature of the lubricant",
        (
            Parameter("viscous_per_K", "1/K", -0.2, 0.2, -0.03, "relative change of viscous friction per kelvin"),
            Parameter("coulomb_per_K", "1/K", -0.2, 0.2, -0.01, "relative change of Coulomb friction per kelvin"),
            Parameter("reference_C", "°C", -50.0, 150.0, 22.0, "temperature at which the robot file's friction holds"),
            Parameter("time_constant_s", "s", 1.0, 1e5, 900.0, "of the lubricant's warming"),
            Parameter("rise_K_W", "K/W", 0.0, 100.0, 1.0, "lubricant above ambient in the long run, per watt lost"),
            Parameter("sensor_lag_s", "s", 0.0, 1e4, 30.0, "by which the cell's temperature register follows"),
        ),
    ),
    "friction.presliding": Kind(
        "joint",
        "friction that builds up over a small displacement after each reversal",
        (
            Parameter(
                "distance_rad", "rad", 1e-9, 1.0, 2e-4, "displacement from rest to 63 % of Coulomb friction", "range"
            ),
            Parameter("damping_Nms_rad", "N·m·s/rad", 0.0, _ANY, 0.0, "torque per speed while it builds up"),
        ),
    ),
    "friction.position": Kind(
        "joint",
        "friction that is higher (or lower) in one part of the range",
        (
            _AMPLITUDE,
            Parameter("centre_rad", "rad", -_ANY, _ANY, 0.0, "where it peaks"),
            Parameter("width_rad", "rad", 1e-6, _ANY, 0.08, "half of its width at half of its height", "range"),
        ),
        repeatable=True,
    ),
    "transmission.elasticity": Kind(
        "joint",
        "a spring between motor and link; the encoder sits on the motor",
        (
            _STIFFNESS,
            _DAMPING,
            Parameter("cubic_Nm_rad3", "N·m/rad³", 0.0, 1e18, 0.0, "hardening: torque per third power of twist"),
            _MOTOR_INERTIA,
        ),
    ),
    "transmission.backlash": Kind(
        "joint",
        "play between motor and link; the encoder sits on the motor",
        (
            Parameter("gap_rad", "rad", 0.0, 1.0, 1e-3, "free travel from flank to flank", "range"),
            msgspec.structs.replace(_STIFFNESS, default=90000.0),
            msgspec.structs.replace(_DAMPING, default=30.0),
            _MOTOR_INERTIA,
        ),
    ),
    "transmission.efficiency": Kind(
        "joint",
        "a gear that loses a share of the power it transmits, driving and braking",
        (
            Parameter("driving", "", 0.2, 1.0, 0.85, "torque at the link over torque at the motor, motor driving"),
            Parameter("braking", "", 0.0, 1.0, 0.85, "torque at the motor over torque at the link, link driving"),
        ),
    ),
    "transmission.coupling": Kind(
        "joint",
        "parts that turn with two joints together: friction and inertia on v + ratio * v(other)",
        (
            Parameter("viscous_Nms_rad", "N·m·s/rad", 0.0, _ANY, 0.0, "viscous friction on that speed"),
            Parameter("coulomb_Nm", "N·m", 0.0, _ANY, 0.5, "Coulomb friction on that speed", "coulomb"),
            Parameter("inertia_kgm2", "kg·m²", 0.0, _ANY, 0.0, "inertia of these parts, on the joint side"),
            Parameter("ratio", "rad/rad", -100.0, 100.0, 1.0, "turns per turn of the other joint"),
            Parameter("other", "", 0.0, 12.0, 0.0, "number of the other joint, from 1; 0: the one before"),
        ),
        repeatable=True,
        least_joints=2,
    ),
    "motor.ripple": Kind(
        "joint",
        "torque that depends on the motor's angle: cogging and torque ripple",
        (
            _AMPLITUDE,
            Parameter("order", "1/rev", 1e-3, 1e4, 1.0, "periods per revolution of the motor"),
            _phase(),
            Parameter("second_Nm", "N·m", -_ANY, _ANY, 0.0, "amplitude of twice that order"),
            _phase("second_phase_rad"),
            Parameter("per_current_Nm_A", "N·m/A", -_ANY, _ANY, 0.0, "amplitude that grows with current"),
        ),
        repeatable=True,
    ),
    "motor.saturation": Kind(
        "joint",
        "a torque constant that falls at large current",
        (
            Parameter("loss", "", 0.0, 0.8, 0.15, "share of the torque missing at current_A"),
            Parameter("current_A", "A", 1e-6, 1e6, 1.0, "current at which loss is meant", "current"),
        ),
    ),
    "drive.gain": Kind(
        "joint",
        "a drive gain other than the nominal one, which the drive goes on reporting",
        (Parameter("error", "", -0.6, 1.5, 0.08, "true over nominal torque per ampere, minus 1"),),
    ),
    "drive.delay": Kind(
        "either",
        "currents reported later than their time stamp says",
        (
            Parameter("delay_s", "s", 0.0, 0.05, 0.001, "age beyond the nominal one"),
            Parameter("filter_s", "s", 0.0, 0.05, 0.0, "time constant of a smoothing filter, which adds to the age"),
        ),
    ),
    "drive.current_offset": Kind(
        "joint",
        "a current sensor that does not read zero at zero current",
        (Parameter("offset_A", "A", -1e6, 1e6, 0.03, "reported minus true current", "current"),),
    ),
    "sensor.eccentricity": Kind(
        "joint",
        "an encoder disc off the axis of its shaft",
        (
            Parameter("amplitude_rad", "rad", -1.0, 1.0, 2e-4, "largest error of the position", "range"),
            Parameter("order", "1/rev", 1e-3, 1e3, 1.0, "periods per revolution of the motor"),
            _phase(),
        ),
    ),
    "spring": Kind(
        "joint",
        "a spring, hose or cable that pulls the joint to a position",
        (
            Parameter("stiffness_Nm_rad", "N·m/rad", -_ANY, _ANY, 0.03, "torque per displacement", "torque"),
            Parameter("centre_rad", "rad", -_ANY, _ANY, 0.0, "where it pulls to"),
            Parameter("cubic_Nm_rad3", "N·m/rad³", -1e15, 1e15, 0.0, "torque per third power of displacement"),
            Parameter("progressive_rad", "rad", 0.0, _ANY, 0.0, "displacement from which it stiffens; 0: never"),
        ),
        repeatable=True,
    ),
    "payload": Kind(
        "arm",
        "a body on the last link that the robot file does not know",
        (
            Parameter("mass_kg", "kg", -1e3, 1e4, 0.5, "mass"),
            Parameter("x_m", "m", -10.0, 10.0, 0.0, "centre of mass in the last link's frame"),
            Parameter("y_m", "m", -10.0, 10.0, 0.0, "centre of mass"),
            Parameter("z_m", "m", -10.0, 10.0, 0.0, "centre of mass"),
            Parameter("inertia_kgm2", "kg·m²", 0.0, 1e3, 0.0, "moment of inertia about every axis through its centre"),
        ),
    ),
    "base.tilt": Kind(
        "arm",
        "a base that does not stand upright",
        (
            Parameter("x_rad", "rad", -0.8, 0.8, 0.03, "turn of the base about its own x"),
            Parameter("y_rad", "rad", -0.8, 0.8, 0.0, "turn of the base about its own y"),
        ),
    ),
    "base.flexibility": Kind(
        "arm",
        "a base that gives way: rocking about x and y, or sliding along a first prismatic axis",
        (
            Parameter("frequency_Hz", "Hz", 0.5, 500.0, 12.0, "natural frequency with the arm at its zero position"),
            Parameter("damping", "", 0.0, 1.0, 0.03, "share of critical damping"),
            Parameter("inertia_kgm2", "kg·m²", 1e-3, 1e6, 10.0, "of the base about the rocking axes, without the arm"),
            Parameter("height_m", "m", -10.0, 10.0, 0.3, "of the robot's base above the rocking axes"),
        ),
    ),
    "contact": Kind(
        "joint",
        "an obstacle that appears before the moving joint once, and goes away",
        (
            Parameter("start_s", "s", 0.0, _ANY, 5.0, "when it appears, from power on"),
            Parameter("duration_s", "s", 1e-4, _ANY, 0.3, "how long it stays"),
            Parameter("stiffness_Nm_rad", "N·m/rad", 1e-3, 1e12, 5000.0, "torque per penetration", "inertia"),
            Parameter("limit_Nm", "N·m", 0.0, _ANY, 0.15, "torque at which it gives way", "torque"),
        ),
        repeatable=True,
    ),
    "disturbance.periodic": Kind(
        "joint",
        "a torque that returns in time, whatever the arm does: a fan, mains hum, a machine nearby",
        (
            _AMPLITUDE,
            Parameter("frequency_Hz", "Hz", 1e-3, 2e3, 16.7, "of the disturbance"),
            _phase(),
        ),
        repeatable=True,
    ),
}
