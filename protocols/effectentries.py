"""Effects as a user writes them: `KEY@JOINT:name=value,name=value` and `[[effect]]` tables, checked against an arm."""

import math
from collections import Counter
from collections.abc import Sequence

import msgspec

from protocols.effectparams import EFFECT_KINDS, Kind, Parameter
from protocols.effects import EFFECTS
from protocols.errors import ConfigError
from protocols.robot import EffectEntry, Joint, Robot

_SYNTAX = "KEY@JOINT:name=value,name=value"


def parse_effect(text: str) -> EffectEntry:
    """Effect of the text of `--effect`, for example `friction.stribeck@joint2:stiction_Nm=3,velocity_rad_s=0.05`.

    Raises:
        ConfigError: No such effect or parameter, a value that is no number, or another syntax.
    """
    where, _, values = text.partition(":")
    key, _, joint = where.strip().partition("@")
    if key not in EFFECTS:
        raise ConfigError(
            f"--effect {text}: there is no effect {key or '(empty)'}. Known are {', '.join(EFFECT_KINDS)}."
        )
    parameters: dict[str, float] = {}
    for item in filter(None, (part.strip() for part in values.split(","))):
        name, equals, number = (part.strip() for part in item.partition("="))
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if not equals or not math.isfinite(value):
            raise ConfigError(f"--effect {text}: {item} is not name=number. Write {_SYNTAX}.")
        if name in parameters:
            raise ConfigError(f"--effect {text}: {name} is given twice.")
        parameters[name] = value
    entry = msgspec.convert({"effect": key, "joint": joint.strip(), "parameters": parameters}, EffectEntry)
    kind = _kind(entry, f"--effect {text}")
    _known(entry, kind, f"--effect {text}")
    return entry


def format_effect(entry: EffectEntry) -> str:
    """The text that `parse_effect` reads back."""
    values = ",".join(f"{name}={value:.9g}" for name, value in entry.parameters.items())
    return f"{entry.effect}{'@' * bool(entry.joint)}{entry.joint}{':' * bool(values)}{values}"


def check_effects(entries: Sequence[EffectEntry], robot: Robot, source: str) -> list[EffectEntry]:
    """The effects with every parameter filled in.

    Args:
        source: Name of the file or flag for messages.

    Raises:
        ConfigError: An effect that an arm cannot have or the emulator cannot simulate, twice the same, an unknown
            joint or parameter, a value out of range; says what there is.
    """
    for (effect, joint), count in Counter((e.effect, e.joint) for e in entries).items():
        if count > 1 and effect in EFFECT_KINDS and not EFFECT_KINDS[effect].repeatable:
            raise ConfigError(f"{source}: {effect}{'@' * bool(joint)}{joint} is given {count} times; give it once.")
    return [_complete(entry, robot, source) for entry in entries]


def default_of(parameter: Parameter, joint: Joint | None) -> float:
    """Value of a parameter that is not given; effects of the whole arm have no axis to scale with."""
    if not parameter.of or joint is None:
        return parameter.default
    drive = joint.drive
    scale = {
        "coulomb": joint.parameters.coulomb_Nm + joint.parameters.motor_coulomb_Nm or 0.02 * joint.torque_max_Nm,
        "torque": joint.torque_max_Nm,
        "speed": joint.velocity_max_rad_s,
        "range": min(joint.position_max_rad - joint.position_min_rad, 2 * math.pi),
        "inertia": joint.control.inertia_kgm2 if joint.control else joint.torque_max_Nm / 100,
        "current": drive.max_current_A,
    }[parameter.of]
    return parameter.default * scale


def _kind(entry: EffectEntry, source: str) -> Kind:
    if entry.effect not in EFFECT_KINDS:
        raise ConfigError(
            f"{source}: {entry.effect} is what explain answers where nothing listed fits; it cannot be emulated."
            f" Emulated are {', '.join(EFFECT_KINDS)}."
        )
    return EFFECT_KINDS[entry.effect]


def _known(entry: EffectEntry, kind: Kind, source: str) -> None:
    for name in entry.parameters:
        if name not in kind.names:
            raise ConfigError(f"{source}: {entry.effect} has no parameter {name}. It has {', '.join(kind.names)}.")


def _complete(entry: EffectEntry, robot: Robot, source: str) -> EffectEntry:
    kind = _kind(entry, source)
    axis = _axis(entry, kind, robot, source)
    _known(entry, kind, source)
    values = {}
    for parameter in kind.parameters:
        given = parameter.name in entry.parameters
        value = entry.parameters[parameter.name] if given else default_of(parameter, axis)
        if not parameter.low <= value <= parameter.high:
            unit = f" {parameter.unit}" * bool(parameter.unit)
            raise ConfigError(
                f"{source}: {entry.effect}{'@' * bool(entry.joint)}{entry.joint}: {parameter.name} = {value:g}{unit}"
                f" is outside {parameter.low:g} to {parameter.high:g}{unit} ({parameter.meaning})."
            )
        values[parameter.name] = value
    if entry.effect == "transmission.coupling":
        _check_other(entry.joint, values["other"], robot, source)
    return msgspec.structs.replace(entry, parameters=values)


def _axis(entry: EffectEntry, kind: Kind, robot: Robot, source: str) -> Joint | None:
    """Joint of an effect; None where it belongs to the arm."""
    names = robot.joint_names
    if robot.joints < kind.least_joints:
        raise ConfigError(
            f"{source}: {entry.effect} needs at least {kind.least_joints} joints ({kind.sentence}); {robot.name} has"
            f" {robot.joints}."
        )
    if kind.place == "arm" and entry.joint:
        raise ConfigError(
            f"{source}: {entry.effect} belongs to the whole arm, not to {entry.joint}. Leave the joint out."
        )
    if kind.place == "joint" and not entry.joint:
        raise ConfigError(f"{source}: {entry.effect} needs a joint: one of {', '.join(names)}.")
    if entry.joint and entry.joint not in names:
        raise ConfigError(f"{source}: {entry.effect}: {robot.name} has no joint {entry.joint}, but {', '.join(names)}.")
    return robot.joint[names.index(entry.joint)] if entry.joint else None


def _check_other(joint: str, other: float, robot: Robot, source: str) -> None:
    own = robot.joint_names.index(joint) + 1
    partner = round(other) or own - 1
    if other not in (partner, 0) or not 1 <= partner <= robot.joints or partner == own:
        raise ConfigError(
            f"{source}: transmission.coupling@{joint}: other = {other:g} is not the number of another joint of"
            f" {robot.name}, 1 to {robot.joints}; {joint} itself is {own}."
        )
