"""What a blind trial may hide: effects at random, in sizes that machines have, and a number that makes each weaker."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import msgspec
import numpy as np

from emulator.effects.unlisted import Form
from protocols.effectentries import default_of
from protocols.effectparams import EFFECT_KINDS
from protocols.effects import Effect
from protocols.robot import EffectEntry, Joint, Robot

ALIKE: tuple[frozenset[str], ...] = (
    frozenset({"friction.asymmetric", "drive.current_offset", "base.tilt", "spring"}),
    frozenset({"friction.load", "transmission.efficiency", "motor.saturation"}),
    frozenset({"friction.stribeck", "friction.presliding"}),
    frozenset({"transmission.elasticity", "transmission.backlash", "base.flexibility", "drive.delay"}),
    frozenset({"motor.ripple", "sensor.eccentricity"}),
    frozenset({"drive.gain", "payload"}),
)  # two of one row are never drawn as a pair: one recording can hardly tell them apart


@dataclass(frozen=True)
class Axis:
    """Sizes that an axis' effects scale with."""

    joint: Joint
    coulomb: float
    speed: float
    reach: float
    inertia: float
    gear: float


Draw = Callable[[Axis, np.random.Generator], dict[str, float]]


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _sign(rng: np.random.Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _turn(rng: np.random.Generator) -> float:
    return float(rng.uniform(-np.pi, np.pi))


def _place(axis: Axis, rng: np.random.Generator) -> float:
    """Somewhere the motions go."""
    middle = (axis.joint.position_min_rad + axis.joint.position_max_rad) / 2
    return float(middle + 0.2 * axis.reach * rng.uniform(-1, 1))


def _nonlinear(a: Axis, r: np.random.Generator) -> dict[str, float]:
    power = float(r.choice([r.uniform(0.3, 0.6), r.uniform(1.5, 3.0)]))
    return {"torque_Nm": a.coulomb * r.uniform(0.2, 1.0), "velocity_rad_s": 0.4 * a.speed, "exponent": power}


def _shaft(a: Axis, r: np.random.Generator, low_Hz: float, high_Hz: float, ratio: float) -> dict[str, float]:
    own = a.joint.parameters.rotor_inertia_kgm2
    before = own or 0.25 * a.inertia
    link = max(a.inertia - before, 0.1 * a.inertia)
    w = 2 * np.pi * r.uniform(low_Hz, high_Hz)
    return {
        "stiffness_Nm_rad": w**2 * link,
        "damping_Nms_rad": 2 * ratio * w * link,
        "motor_inertia_kgm2": 0.0 if own else before,
    }


def _ripple(a: Axis, r: np.random.Generator) -> dict[str, float]:
    amplitude = a.coulomb * _log(r, 0.05, 0.6)
    return {
        "amplitude_Nm": amplitude,
        "order": float(r.choice([1, 2, 4, 6])),
        "phase_rad": _turn(r),
        "second_Nm": amplitude * float(r.choice([0.0, r.uniform(0.1, 0.4)])),
        "second_phase_rad": _turn(r),
    }


def _base(a: Axis, r: np.random.Generator) -> dict[str, float]:
    slides = a.joint.kind == "prismatic"
    own = a.inertia * r.uniform(1.0, 4.0) if slides else _log(r, 4.0, 20.0)
    return {
        "frequency_Hz": r.uniform(7.0, 20.0),
        "damping": r.uniform(0.02, 0.08),
        "inertia_kgm2": own,
        "height_m": 0.0 if slides else r.uniform(0.1, 0.6),
    }


def _payload(a: Axis, r: np.random.Generator) -> dict[str, float]:
    if a.joint.kind == "prismatic":
        return {"mass_kg": a.inertia * r.uniform(0.03, 0.3)}
    return {
        "mass_kg": _log(r, 0.15, 1.5),
        "x_m": r.uniform(-0.04, 0.04),
        "y_m": r.uniform(-0.04, 0.04),
        "z_m": r.uniform(0.03, 0.12),
        "inertia_kgm2": 0.001,
    }


DRAWS: Mapping[Effect, Draw] = {
    "friction.stribeck": lambda a, r: {
        "stiction_Nm": a.coulomb * r.uniform(0.15, 0.8),
        "velocity_rad_s": a.speed * _log(r, 0.006, 0.06),
        "exponent": float(r.choice([0.7, 1.0, 1.0, 2.0])),
        "lag_s": float(r.choice([0.0, 0.002, 0.005])),
    },
    "friction.asymmetric": lambda a, r: {"half_difference_Nm": _sign(r) * a.coulomb * r.uniform(0.05, 0.4)},
    "friction.viscous_nonlinear": _nonlinear,
    "friction.load": lambda a, r: {
        "coefficient": r.uniform(0.05, 0.3),
        "preload_Nm": float(r.choice([0.0, a.coulomb * r.uniform(0.2, 1.0)])),
    },
    "friction.temperature": lambda a, r: {
        "viscous_per_K": -r.uniform(0.008, 0.04),
        "coulomb_per_K": -r.uniform(0.003, 0.02),
        "rise_K_W": 0.2,
        "sensor_lag_s": r.uniform(10.0, 60.0),
    },
    "friction.presliding": lambda a, r: {"distance_rad": a.reach * _log(r, 1e-4, 2e-3)},
    "friction.position": lambda a, r: {
        "amplitude_Nm": a.coulomb * r.uniform(0.2, 0.9),
        "centre_rad": _place(a, r),
        "width_rad": a.reach * r.uniform(0.03, 0.1),
    },
    "transmission.elasticity": lambda a, r: _shaft(a, r, 8.0, 30.0, r.uniform(0.02, 0.1)),
    "transmission.backlash": lambda a, r: (
        _shaft(a, r, 30.0, 60.0, r.uniform(0.1, 0.3)) | {"gap_rad": a.reach * _log(r, 2e-4, 3e-3)}
    ),
    "transmission.efficiency": lambda a, r: {"driving": r.uniform(0.65, 0.95), "braking": r.uniform(0.6, 0.95)},
    "transmission.coupling": lambda a, r: {
        "viscous_Nms_rad": a.coulomb / a.speed * r.uniform(0.3, 1.5),
        "coulomb_Nm": a.coulomb * r.uniform(0.2, 0.8),
    },
    "motor.ripple": _ripple,
    "motor.saturation": lambda a, r: {
        "loss": r.uniform(0.05, 0.35),
        "current_A": 0.6 * a.joint.drive.max_current_A,
    },
    "drive.gain": lambda a, r: {"error": _sign(r) * r.uniform(0.04, 0.25)},
    "drive.delay": lambda a, r: {"delay_s": _log(r, 3e-4, 3e-3), "filter_s": float(r.choice([0.0, 5e-4]))},
    "drive.current_offset": lambda a, r: {"offset_A": _sign(r) * a.joint.drive.max_current_A * _log(r, 0.004, 0.05)},
    "sensor.eccentricity": lambda a, r: {
        "amplitude_rad": min(a.reach * _log(r, 1e-5, 3e-4), 0.3 / abs(a.gear)),
        "order": 1.0,
        "phase_rad": _turn(r),
    },
    "spring": lambda a, r: {
        "stiffness_Nm_rad": a.coulomb / a.reach * r.uniform(1.0, 6.0),
        "centre_rad": _place(a, r),
        "progressive_rad": float(r.choice([0.0, 0.3 * a.reach])),
    },
    "payload": _payload,
    "base.tilt": lambda a, r: {"x_rad": _sign(r) * _log(r, 0.004, 0.06), "y_rad": _sign(r) * _log(r, 0.004, 0.06)},
    "base.flexibility": _base,
    "contact": lambda a, r: {
        "start_s": r.uniform(3.5, 8.0),
        "duration_s": r.uniform(0.1, 0.5),
        "stiffness_Nm_rad": a.inertia * (2 * np.pi * r.uniform(10, 30)) ** 2,
        "limit_Nm": a.coulomb * _log(r, 0.7, 4.0),
    },
    "disturbance.periodic": lambda a, r: {
        "amplitude_Nm": a.coulomb * _log(r, 0.05, 0.5),
        "frequency_Hz": r.uniform(3.0, 22.0),
        "phase_rad": _turn(r),
    },
}

STRENGTH: Mapping[str, tuple[tuple[str, float], ...]] = {
    "friction.stribeck": (("stiction_Nm", 1),),
    "friction.asymmetric": (("half_difference_Nm", 1),),
    "friction.viscous_nonlinear": (("torque_Nm", 1),),
    "friction.load": (("coefficient", 1),),
    "friction.temperature": (("viscous_per_K", 1), ("coulomb_per_K", 1)),
    "friction.presliding": (("distance_rad", 1.5),),
    "friction.position": (("amplitude_Nm", 1),),
    "transmission.elasticity": (("stiffness_Nm_rad", -1), ("damping_Nms_rad", -0.5)),
    "transmission.backlash": (("gap_rad", 1),),
    "transmission.coupling": (("viscous_Nms_rad", 1), ("coulomb_Nm", 1)),
    "motor.ripple": (("amplitude_Nm", 1), ("second_Nm", 1)),
    "motor.saturation": (("loss", 1),),
    "drive.gain": (("error", 1),),
    "drive.delay": (("delay_s", 1), ("filter_s", 1)),
    "drive.current_offset": (("offset_A", 1),),
    "sensor.eccentricity": (("amplitude_rad", 1),),
    "spring": (("stiffness_Nm_rad", 1),),
    "payload": (("mass_kg", 1), ("inertia_kgm2", 1)),
    "base.tilt": (("x_rad", 1), ("y_rad", 1)),
    "base.flexibility": (("frequency_Hz", -0.5),),
    "contact": (("limit_Nm", 1),),
    "disturbance.periodic": (("amplitude_Nm", 1),),
    "unlisted": (("a", 1),),
}  # what grows with the strength of each effect, and with which power of it
LEAST_EFFICIENCY = 0.5
LARGEST = {"loss": 0.5, "coefficient": 0.5}  # more would be another machine
MOST_CHANGE = 2.5  # of a drawn parameter: beyond, the effect would be none that machines have


def axis_of(robot: Robot, j: int) -> Axis:
    joint = robot.joint[j]
    return Axis(
        joint=joint,
        coulomb=joint.parameters.coulomb_Nm + joint.parameters.motor_coulomb_Nm,
        speed=joint.velocity_max_rad_s,
        reach=min(joint.position_max_rad - joint.position_min_rad, 2 * np.pi),
        inertia=default_of(EFFECT_KINDS["transmission.elasticity"].parameters[0], joint) / 9000.0,
        gear=joint.drive.gear_ratio,
    )


def draw_effect(effect: Effect, robot: Robot, rng: np.random.Generator) -> EffectEntry:
    """An effect of the vocabulary somewhere on the arm."""
    kind = EFFECT_KINDS[effect]
    first = 1 if effect == "transmission.coupling" else 0
    j = int(rng.integers(first, robot.joints))
    arm = kind.place == "arm" or (kind.place == "either" and robot.joints > 1)
    values = DRAWS[effect](axis_of(robot, robot.joints - 1 if effect == "payload" else j), rng)
    plain = {name: float(value) for name, value in values.items()}
    return EffectEntry(effect=effect, joint="" if arm else robot.joint_names[j], parameters=plain)


def draw_unlisted(robot: Robot, rng: np.random.Generator) -> EffectEntry:
    """Physics that the vocabulary does not have."""
    alone = (Form.FLUID, Form.THIXOTROPIC, Form.GROOVE, Form.CLUTCH)
    form = Form(int(rng.choice(alone if robot.joints == 1 else list(Form))))
    j = int(rng.integers(0, robot.joints))
    other = int(rng.choice([i for i in range(robot.joints) if i != j])) if robot.joints > 1 else j
    axis = axis_of(robot, j)
    a, b = {
        Form.FLUID: (axis.coulomb / axis.speed * 3, _log(rng, 0.1, 0.8)),
        Form.THIXOTROPIC: (axis.coulomb, 0.1 * axis.reach),
        Form.GROOVE: (axis.coulomb / axis.speed * 3, 2 * np.pi / (axis.reach * rng.uniform(0.1, 0.3))),
        Form.CLUTCH: (axis.coulomb * 0.6, axis.speed * rng.uniform(0.1, 0.3)),
        Form.TENDON: (axis.coulomb / axis.reach * 3, -rng.uniform(0.5, 1.0)),
        Form.CHURNING: (axis.coulomb / axis.speed * 3, 0.0),
        Form.SAG: (axis.coulomb * 0.6, 0.0),
    }[form]
    values = {"form": float(form), "other": float(other), "a": float(a), "b": float(b)}
    return EffectEntry(effect="unlisted", joint=robot.joint_names[j], parameters=values)


def scaled(entry: EffectEntry, factor: float) -> EffectEntry:
    """The effect about `factor` times as strong."""
    values = dict(entry.parameters)
    if entry.effect == "transmission.efficiency":
        for name in ("driving", "braking"):
            values[name] = max(1 / (1 + (1 / values[name] - 1) * factor), LEAST_EFFICIENCY)
    for name, power in STRENGTH.get(entry.effect, ()):
        low, high = _range(entry.effect, name)
        values[name] = float(np.clip(values.get(name, 0.0) * factor**power, low, high))
    return msgspec.structs.replace(entry, parameters=values)


def _range(effect: str, name: str) -> tuple[float, float]:
    if name in LARGEST:
        return 0.0, LARGEST[name]
    found = [p for key, kind in EFFECT_KINDS.items() if key == effect for p in kind.parameters if p.name == name]
    return (found[0].low, found[0].high) if found else (-np.inf, np.inf)
