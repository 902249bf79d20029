"""What can be made to go wrong on an emulated bus, as text: `drop@can0:count=3`, `corrupt@can0:id=181`.

    KIND@PLACE[:KEY=VALUE,...]

PLACE is a bus, or a joint: then only what its drive sends under the default identifiers is meant. Keys of all kinds:
`t` begin [s], `for` duration [s], `count` how often, `p` probability, `seed` of it, `id` and `mask` in hexadecimal.

    drop        nobody hears the frame
    duplicate   everybody hears it twice: an error in its very last bit, which only the sender saw
    corrupt     a bit error: error frame, error counters, the frame is repeated, up to bus-off
    delay       its sender queues it late by `ms`
    jitter      as delay, by a random time up to `us`; SYNC where no id is given
    bus-off     the controllers of the place leave the bus at `t` and are back after `restart` milliseconds
"""

from dataclasses import dataclass, field
from enum import StrEnum
from random import Random

from protocols import nmt
from protocols.errors import ConfigError
from protocols.frames import ERROR, EXTENDED, ID_MASK, REMOTE
from protocols.rig import Rig

NEVER_NS = 2**62
RESTART_MS = 100.0  # of a drive's controller that left the bus
EXACT = ID_MASK | EXTENDED | REMOTE | ERROR
_KEYS = ("t", "for", "count", "p", "seed", "id", "mask")


class Kind(StrEnum):
    """See the head of this file."""

    DROP = "drop"
    DUPLICATE = "duplicate"
    CORRUPT = "corrupt"
    DELAY = "delay"
    JITTER = "jitter"
    BUS_OFF = "bus-off"


_OWN_KEYS = {Kind.DELAY: ("ms",), Kind.JITTER: ("us",)}
_KEYS_OF = {kind: (*_KEYS, *_OWN_KEYS.get(kind, ())) for kind in Kind} | {Kind.BUS_OFF: ("t", "restart")}


@dataclass
class Disturbance:
    """One thing that goes wrong.

    Attributes:
        bus, node: Where; without a node, all that is on the bus.
        can_id, mask: Which frames, flags included; mask 0 is all of them.
        begin_ns, end_ns: When, since the run started.
        left: How often still; None without end.
        probability: Of each frame that could be struck.
        delay_ns: Of delay; largest one of jitter.
        restart_ns: Of bus-off; `NEVER_NS` stays off.
        random: Its own generator, so that disturbances do not shift each other.
    """

    kind: Kind
    bus: str
    node: int | None = None
    can_id: int = 0
    mask: int = 0
    begin_ns: int = 0
    end_ns: int = NEVER_NS
    left: int | None = None
    probability: float = 1.0
    delay_ns: int = 0
    restart_ns: int = int(RESTART_MS * 1e6)
    random: Random = field(default_factory=lambda: Random(1))

    def strikes(self, t_ns: int, can_id: int) -> bool:
        """Whether this frame, at this moment, is one of those; counts it."""
        if (
            self.left == 0
            or not self.begin_ns <= t_ns < self.end_ns
            or (can_id ^ self.can_id) & self.mask
            or (self.node is not None and can_id not in sent_by(self.node))
            or (self.probability < 1 and self.random.random() >= self.probability)
        ):
            return False
        if self.left is not None:
            self.left -= 1
        return True

    def lateness_ns(self) -> int:
        """By how much a frame that was struck is late."""
        return self.random.randint(0, self.delay_ns) if self.kind is Kind.JITTER else self.delay_ns


def sent_by(node: int) -> tuple[int, ...]:
    """Identifiers under which a device sends by default (CiA 301, table 39)."""
    pdos = [nmt.tpdo_id(number, node) for number in (1, 2, 3, 4)]
    return nmt.emcy_id(node), *pdos, nmt.sdo_response_id(node), nmt.heartbeat_id(node)


def is_disturbance(text: str) -> bool:
    """Whether a fault's text is one of the bus."""
    return text.partition("@")[0] in set(Kind)


def parse(text: str, rig: Rig) -> Disturbance:
    """Disturbance of its text.

    Raises:
        ConfigError: Not that form, no such kind, place or key; says which there are.
    """
    head, _, tail = text.partition(":")
    name, _, place = head.partition("@")
    if name not in set(Kind):
        raise ConfigError(f"fault {text}: {name or 'nothing'} is none of the bus's: {', '.join(Kind)}.")
    kind = Kind(name)
    bus, node = _place(text, place, rig)
    values: dict[str, str] = {}
    for pair in tail.split(",") if tail else []:
        key, equals, value = pair.partition("=")
        if key not in _KEYS_OF[kind] or not equals:
            raise ConfigError(f"fault {text}: {pair!r} is no setting of {kind}; write {', '.join(_KEYS_OF[kind])}=...")
        values[key] = value
    begin_s = _number(text, values, "t", 0.0)
    jitter = kind is Kind.JITTER
    default_id = f"{nmt.SYNC:X}" if jitter and node is None else None
    can_id = _hexadecimal(text, values, "id", default_id)
    p = _number(text, values, "p", 1.0)
    if p > 1:
        raise ConfigError(f"fault {text}: p={p:g} is no probability; write one between 0 and 1.")
    delay_s = _number(text, values, "us", 0.0) * 1e-6 + _number(text, values, "ms", 0.0) * 1e-3
    if kind in _OWN_KEYS and delay_s == 0:
        raise ConfigError(f"fault {text}: by how much? Write {_OWN_KEYS[kind][0]}=...")
    restart_ms = _number(text, values, "restart", RESTART_MS)
    return Disturbance(
        kind,
        bus,
        node,
        can_id or 0,
        0 if can_id is None else _hexadecimal(text, values, "mask", f"{EXACT:X}") or 0,
        round(begin_s * 1e9),
        NEVER_NS if "for" not in values else round((begin_s + _number(text, values, "for", 0.0)) * 1e9),
        int(_number(text, values, "count", 0)) if "count" in values else None,
        p,
        round(delay_s * 1e9),
        round(restart_ms * 1e6) or NEVER_NS,
        Random(int(_number(text, values, "seed", 1))),
    )


def _place(text: str, place: str, rig: Rig) -> tuple[str, int | None]:
    for drive in rig.drive:
        if drive.joint == place:
            return drive.bus, drive.node
    buses, joints = [b.name for b in rig.bus], [d.joint for d in rig.drive]
    if place not in buses:
        raise ConfigError(
            f"fault {text}: {rig.name} has no {place or 'such place'}; write one of {', '.join(buses + joints)}."
        )
    return place, None


def _number(text: str, values: dict[str, str], key: str, default: float) -> float:
    try:
        value = float(values.get(key, default))
    except ValueError:
        raise ConfigError(f"fault {text}: {key}={values[key]} is no number.") from None
    if not 0 <= value < NEVER_NS * 1e-9:  # also NaN
        raise ConfigError(f"fault {text}: {key}={values[key]} must be a number from 0 on.")
    return value


def _hexadecimal(text: str, values: dict[str, str], key: str, default: str | None) -> int | None:
    given = values.get(key, default)
    try:
        return None if given is None else int(given, 16)
    except ValueError:
        raise ConfigError(f"fault {text}: {key}={given} is no hexadecimal number, such as {key}=181.") from None
