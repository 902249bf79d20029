"""What can be made to go wrong in an emulated drive, as text: `heartbeat-loss@joint3:t=5`, `emcy@joint1:t=2,code=4310`.

    KIND[@PLACE][:KEY=VALUE,...]

PLACE is a joint, or a bus for all its drives; without it all drives are meant. `t` is when it begins [s], `for` how
long it lasts [s]; without `for` it stays.

    heartbeat-loss        the drive's heartbeats stop
    sdo-silence           it answers no SDO request
    sync-loss             it hears no SYNC
    sync-jump             it hears one SYNC with a counter that is off by `by` (1)
    offline               unplugged: hears nothing, says nothing; its controller goes bus-off
    power-loss            no supply; boots when it is back
    reset-node, reset-communication, stop, pre-operational
                          its NMT state changes by itself
    emcy                  a fault with the error code `code`, in hexadecimal
    overcurrent, overvoltage, undervoltage, overtemperature
                          faults with the codes of CiA 402
    encoder               the position stays where it was read last, and the drive notices: a fault
    duplicate-node        another device with the same node-id boots and sends heartbeats
    garbage               `count` (100) random frames on the drive's bus, drawn with `seed` (1)

What goes wrong on a bus, lost and damaged frames for instance, is in `disturbance`.
"""

import math
from dataclasses import dataclass
from enum import StrEnum

from protocols import emcy, nmt
from protocols.errors import ConfigError

NEVER_NS = 2**62


class Kind(StrEnum):
    """See the head of this file."""

    HEARTBEAT_LOSS = "heartbeat-loss"
    SDO_SILENCE = "sdo-silence"
    SYNC_LOSS = "sync-loss"
    SYNC_JUMP = "sync-jump"
    OFFLINE = "offline"
    POWER_LOSS = "power-loss"
    RESET_NODE = "reset-node"
    RESET_COMMUNICATION = "reset-communication"
    STOP = "stop"
    PRE_OPERATIONAL = "pre-operational"
    EMCY = "emcy"
    OVERCURRENT = "overcurrent"
    OVERVOLTAGE = "overvoltage"
    UNDERVOLTAGE = "undervoltage"
    OVERTEMPERATURE = "overtemperature"
    ENCODER = "encoder"
    DUPLICATE_NODE = "duplicate-node"
    GARBAGE = "garbage"


_LASTING = ("t", "for")
_KEYS: dict[Kind, tuple[str, ...]] = {kind: ("t",) for kind in Kind} | {
    Kind.HEARTBEAT_LOSS: _LASTING,
    Kind.SDO_SILENCE: _LASTING,
    Kind.SYNC_LOSS: _LASTING,
    Kind.SYNC_JUMP: ("t", "by"),
    Kind.OFFLINE: _LASTING,
    Kind.POWER_LOSS: _LASTING,
    Kind.EMCY: ("t", "code"),
    Kind.ENCODER: _LASTING,
    Kind.DUPLICATE_NODE: _LASTING,
    Kind.GARBAGE: ("t", "count", "seed"),
}

CODES = {
    Kind.OVERCURRENT: emcy.Code.OVERCURRENT,
    Kind.OVERVOLTAGE: emcy.Code.DC_LINK_OVERVOLTAGE,
    Kind.UNDERVOLTAGE: emcy.Code.DC_LINK_UNDERVOLTAGE,
    Kind.OVERTEMPERATURE: emcy.Code.DRIVE_OVERTEMPERATURE,
    Kind.ENCODER: emcy.Code.ENCODER,
}
COMMANDS = {
    Kind.RESET_NODE: nmt.Command.RESET_NODE,
    Kind.RESET_COMMUNICATION: nmt.Command.RESET_COMMUNICATION,
    Kind.STOP: nmt.Command.STOP,
    Kind.PRE_OPERATIONAL: nmt.Command.ENTER_PRE_OPERATIONAL,
}


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong.

    Attributes:
        text: As it was written.
        place: Joint or bus; empty for all drives.
        begin_ns, end_ns: When, since the rig started.
        code: Error code, of kinds that are faults of the drive.
        by: How far a counter is off.
        count, seed: How many random frames, and which.
    """

    text: str
    kind: Kind
    place: str = ""
    begin_ns: int = 0
    end_ns: int = NEVER_NS
    code: int = 0
    by: int = 1
    count: int = 100
    seed: int = 1


def is_fault(text: str) -> bool:
    """Whether a text names one of these kinds."""
    return _name(text) in set(Kind)


def parse_fault(text: str) -> Fault:
    """Fault of its text.

    Raises:
        ConfigError: Not that form, no such kind or key, or a value that cannot be; says what there is.
    """
    name = _name(text)
    if name not in set(Kind):
        raise ConfigError(f"fault {text}: {name or 'nothing'} is none of the drives': {', '.join(Kind)}.")
    kind = Kind(name)
    head, _, tail = text.partition(":")
    values: dict[str, str] = {}
    for pair in tail.split(",") if tail else []:
        key, equals, value = pair.partition("=")
        if key not in _KEYS[kind] or not equals:
            raise ConfigError(f"fault {text}: {pair!r} is no setting of {kind}; write {', '.join(_KEYS[kind])}=...")
        values[key] = value
    code = CODES.get(kind, 0)
    if kind is Kind.EMCY:
        if "code" not in values:
            raise ConfigError(f"fault {text}: which error? Write emcy@PLACE:code=4310, an error code in hexadecimal.")
        code = _code(text, values["code"])
    begin_s = _number(text, values, "t", 0.0)
    end_s = begin_s + _number(text, values, "for", math.inf)
    return Fault(
        text,
        kind,
        head.partition("@")[2],
        round(1e9 * begin_s),
        NEVER_NS if math.isinf(end_s) else round(1e9 * end_s),
        code,
        round(_number(text, values, "by", 1)),
        round(_number(text, values, "count", 100)),
        round(_number(text, values, "seed", 1)),
    )


def _name(text: str) -> str:
    return text.partition(":")[0].partition("@")[0]


def _number(text: str, values: dict[str, str], key: str, default: float) -> float:
    if key not in values:
        return default
    try:
        value = float(values[key])
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise ConfigError(f"fault {text}: {key}={values[key]} must be a number from 0 on.")
    return value


def _code(text: str, value: str) -> int:
    try:
        code = int(value, 16)
    except ValueError:
        code = 0
    if not 0 < code <= 0xFFFF:
        raise ConfigError(f"fault {text}: code={value} is no error code; write four hexadecimal digits such as 4310.")
    return code
