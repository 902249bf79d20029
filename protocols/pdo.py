"""Process data objects (CiA 301, 7.2.2): which objects share a frame, in which bytes, and how to tell a device so.

Whole bytes only: every mapped object is 8, 16 or 32 bits long, so a frame is one `struct`.
"""

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import itemgetter

import msgspec

from protocols.dictionary import ENTRIES, INVALID, NO_RTR
from protocols.errors import ConfigError
from protocols.frames import MAX_DATA
from protocols.objects import FORMAT, Dictionary, Entry, Value, key
from protocols.sdo import Abort, SdoError

LAST_SYNCHRONOUS = 240  # transmission types 0 and 1 to 240 follow SYNC
EVENT_TYPES = (254, 255)
SAMPLED_ON_SYNC, ON_REQUEST = 252, 253  # sent when a remote frame asks for them
RECEIVE = 0x1400  # communication parameters of RPDO 1; the mappings are 0x200 above
TRANSMIT = 0x1800
MAPPING_OFFSET = 0x200


class Mapped(msgspec.Struct, frozen=True):
    """One object in a PDO."""

    index: int
    sub: int
    bits: int

    @property
    def word(self) -> int:
        """As it stands in 0x1600 and 0x1A00."""
        return self.index << 16 | self.sub << 8 | self.bits

    @classmethod
    def from_word(cls, word: int) -> "Mapped":
        return cls(word >> 16, word >> 8 & 0xFF, word & 0xFF)

    @classmethod
    def parse(cls, text: str) -> "Mapped":
        """Object of a rig file's `6064:0/32`: index and sub-index in hexadecimal, bits in decimal.

        Raises:
            ConfigError: Not of that form.
        """
        address, _, bits = text.partition("/")
        index, _, sub = address.partition(":")
        try:
            mapped = cls(int(index, 16), int(sub, 16), int(bits))
        except ValueError:
            mapped = cls(-1, -1, -1)
        if not (0 <= mapped.index <= 0xFFFF and 0 <= mapped.sub <= 0xFF and 0 < mapped.bits <= 8 * MAX_DATA):
            raise ConfigError(f"PDO layout: {text!r} is not an object; write INDEX:SUB/BITS such as 6064:0/32.")
        return mapped


class Layout:
    """Codec of one PDO.

    Attributes:
        entries: The mapped objects in order.
        keys: Their keys, in the same order.
        size: Bytes.
        pack: Data bytes of the values in a mapping by key.
        unpack: Values in order, of at least `size` bytes.
    """

    __slots__ = ("entries", "keys", "pack", "size", "unpack")

    def __init__(self, entries: Sequence[Entry]) -> None:
        codec = struct.Struct("<" + "".join(FORMAT[e.type] for e in entries))
        keys = tuple(e.key for e in entries)
        self.entries = tuple(entries)
        self.keys = keys
        self.size = codec.size
        self.unpack: Callable[[bytes], tuple[Value, ...]] = codec.unpack_from
        self.pack: Callable[[Mapping[int, Value]], bytes]
        if len(keys) > 1:  # 12 000 times a second: itemgetter and one struct are the fastest pair
            pick, write = itemgetter(*keys), codec.pack
            self.pack = lambda values: write(*pick(values))
        else:
            self.pack = lambda values: codec.pack(*(values[k] for k in keys))

    @property
    def mapped(self) -> tuple[Mapped, ...]:
        """The objects as `configuration` wants them."""
        return tuple(Mapped(e.index, e.sub, e.bits) for e in self.entries)


def compile_mapping(words: Iterable[int], dictionary: Dictionary, *, transmit: bool) -> Layout:
    """Layout of mapping words, as a device checks them.

    Args:
        transmit: Seen from the device: TPDOs need readable objects, RPDOs writable ones.

    Raises:
        SdoError: An object that cannot be mapped, or not with that length; more than eight bytes.
    """
    entries = []
    for word in words:
        mapped = Mapped.from_word(word)
        entry = dictionary.entries.get(key(mapped.index, mapped.sub))
        if entry is None or not entry.mappable or mapped.bits != entry.bits:
            raise SdoError(Abort.NOT_MAPPABLE)
        if not (entry.readable if transmit else entry.writable):
            raise SdoError(Abort.NOT_MAPPABLE)
        entries.append(entry)
    if len(entries) > ENTRIES or sum(e.bits for e in entries) > 8 * MAX_DATA:
        raise SdoError(Abort.PDO_LENGTH)
    return Layout(entries)


def parse_layout(texts: Iterable[str], dictionary: Dictionary, *, transmit: bool) -> Layout:
    """Layout of a rig file's list such as `["6064:0/32", "6078:0/16"]`.

    Raises:
        ConfigError: Not of that form, or the drive would refuse it.
    """
    mapped = [Mapped.parse(t) for t in texts]
    kind = "TPDO" if transmit else "RPDO"
    for text, one in zip(texts, mapped, strict=True):
        try:
            compile_mapping([one.word], dictionary, transmit=transmit)
        except SdoError:
            raise ConfigError(
                f"PDO layout: {text} cannot be part of a {kind}; the drive has no such object, of another length, or"
                f" does not allow it."
            ) from None
    total = sum(m.bits for m in mapped)
    if total > 8 * MAX_DATA:
        raise ConfigError(f"PDO layout: {', '.join(texts)} take {total} bits; a CAN frame carries 64.")
    return compile_mapping((m.word for m in mapped), dictionary, transmit=transmit)


def configuration(
    base: int,
    number: int,
    cob_id: int,
    mapped: Sequence[Mapped],
    transmission_type: int,
    *,
    inhibit_100us: int | None = None,
    event_ms: int | None = None,
) -> list[tuple[int, int, bytes]]:
    """SDO downloads that give a PDO a new content by the standard procedure (CiA 301, 7.5.2.36): switch it off,
    empty the mapping, write the entries, set their number, switch it on.

    Args:
        base: `RECEIVE` or `TRANSMIT`, seen from the device.
        number: From 1.

    Returns:
        Index, sub-index and data, in order.
    """
    communication = base + number - 1
    mapping = communication + MAPPING_OFFSET
    used = cob_id | (NO_RTR if base == TRANSMIT else 0)
    writes = [
        (communication, 1, (used | INVALID).to_bytes(4, "little")),
        (communication, 2, bytes((transmission_type,))),
    ]
    if inhibit_100us is not None:
        writes.append((communication, 3, inhibit_100us.to_bytes(2, "little")))
    if event_ms is not None:
        writes.append((communication, 5, event_ms.to_bytes(2, "little")))
    writes.append((mapping, 0, b"\0"))
    writes += [(mapping, i, m.word.to_bytes(4, "little")) for i, m in enumerate(mapped, 1)]
    writes.append((mapping, 0, bytes((len(mapped),))))
    writes.append((communication, 1, used.to_bytes(4, "little")))
    return writes
