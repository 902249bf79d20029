"""Objects of a CANopen dictionary: what they hold, who may touch them, how their values travel (CiA 301, 7.4)."""

import math
import struct
from collections.abc import Iterable
from enum import IntEnum
from typing import Literal, TypedDict, Unpack

import msgspec

from protocols.sdo import Abort, SdoError

Value = int | float | str
Access = Literal["ro", "rw", "wo", "const"]

LONGEST_STRING = 64  # bytes a VISIBLE_STRING may be written with


class Type(IntEnum):
    """Data types by their index in the dictionary (CiA 301, table 44)."""

    INTEGER8 = 0x02
    INTEGER16 = 0x03
    INTEGER32 = 0x04
    UNSIGNED8 = 0x05
    UNSIGNED16 = 0x06
    UNSIGNED32 = 0x07
    REAL32 = 0x08
    VISIBLE_STRING = 0x09
    DOMAIN = 0x0F


class Code(IntEnum):
    """Object codes (CiA 301, table 42)."""

    VAR = 0x07
    ARRAY = 0x08
    RECORD = 0x09


FORMAT = {  # of `struct`, little-endian; strings and domains have none
    Type.INTEGER8: "b",
    Type.INTEGER16: "h",
    Type.INTEGER32: "i",
    Type.UNSIGNED8: "B",
    Type.UNSIGNED16: "H",
    Type.UNSIGNED32: "I",
    Type.REAL32: "f",
}
_CODEC = {kind: struct.Struct("<" + code) for kind, code in FORMAT.items()}


def key(index: int, sub: int = 0) -> int:
    """Index and sub-index as one number, `index * 256 + sub`: values are kept and mapped by it."""
    return index << 8 | sub


class Entry(msgspec.Struct, frozen=True, kw_only=True):
    """One value of a dictionary.

    Attributes:
        default: After power on; plus the node-id where `node_relative`.
        low, high: Limits of what may be written; None where the type alone limits.
        mappable: May be part of a PDO.
        unit: For people and generated documents.
        volatile: A command or a history, not a setting: never stored by 0x1010.
    """

    index: int
    sub: int
    name: str
    type: Type
    access: Access
    default: Value
    low: float | None = None
    high: float | None = None
    mappable: bool = False
    unit: str = ""
    node_relative: bool = False
    volatile: bool = False

    @property
    def key(self) -> int:
        return key(self.index, self.sub)

    @property
    def readable(self) -> bool:
        return self.access != "wo"

    @property
    def writable(self) -> bool:
        return self.access in {"rw", "wo"}

    @property
    def bits(self) -> int:
        """Length in a PDO; 0 for strings and domains."""
        return 8 * _CODEC[self.type].size if self.type in _CODEC else 0

    @property
    def sizes(self) -> tuple[int, int]:
        """Fewest and most bytes of a value."""
        return (self.bits // 8, self.bits // 8) if self.bits else (0, LONGEST_STRING)

    def encode(self, value: Value) -> bytes:
        """Bytes as they go over the bus."""
        if isinstance(value, str):
            return value.encode("latin-1")
        return _CODEC[self.type].pack(value)

    def decode(self, data: bytes) -> Value:
        """Value of bytes; their number must be within `sizes`."""
        if self.type not in _CODEC:
            return data.decode("latin-1")
        value: int | float = _CODEC[self.type].unpack(data)[0]
        return value

    def check(self, value: Value) -> None:
        """Refuse what the object cannot hold.

        Raises:
            SdoError: Beyond a limit, or not a number.
        """
        if isinstance(value, str):
            return
        if not math.isfinite(value):
            raise SdoError(Abort.VALUE, self.index, self.sub)
        if self.high is not None and value > self.high:
            raise SdoError(Abort.TOO_HIGH, self.index, self.sub)
        if self.low is not None and value < self.low:
            raise SdoError(Abort.TOO_LOW, self.index, self.sub)


class Object(msgspec.Struct, frozen=True):
    """One index of a dictionary with its entries in order of sub-index."""

    index: int
    name: str
    code: Code
    entries: tuple[Entry, ...]


class Dictionary:
    """Objects of one kind of device, with defaults that depend on the node-id only.

    Attributes:
        objects: By index.
        entries: By `key`.
    """

    def __init__(self, objects: Iterable[Object]) -> None:
        self.objects = {o.index: o for o in objects}
        self.entries = {e.key: e for o in self.objects.values() for e in o.entries}

    def find(self, index: int, sub: int = 0) -> Entry:
        """Entry of an address.

        Raises:
            SdoError: No such object or sub-index.
        """
        entry = self.entries.get(key(index, sub))
        if entry is None:
            raise SdoError(Abort.NO_SUBINDEX if index in self.objects else Abort.NO_OBJECT, index, sub)
        return entry

    def defaults(self, node_id: int) -> dict[int, Value]:
        """Values after power on, by key."""
        return {
            k: e.default + node_id if e.node_relative and not isinstance(e.default, str) else e.default
            for k, e in self.entries.items()
        }


class Options(TypedDict, total=False):
    """What most entries leave at its default; see `Entry`."""

    low: float
    high: float
    mappable: bool
    unit: str
    node_relative: bool
    volatile: bool


def sub(number: int, name: str, kind: Type, access: Access, default: Value, **options: Unpack[Options]) -> Entry:
    """One entry of a `record`."""
    return Entry(index=0, sub=number, name=name, type=kind, access=access, default=default, **options)


def var(index: int, name: str, kind: Type, access: Access, default: Value, **options: Unpack[Options]) -> Object:
    """An object that is one value, at sub-index 0."""
    entry = Entry(index=index, sub=0, name=name, type=kind, access=access, default=default, **options)
    return Object(index, name, Code.VAR, (entry,))


def record(index: int, name: str, *subs: Entry) -> Object:
    """An object with several values; sub-index 0, unless given, is the highest sub-index."""
    return Object(index, name, Code.RECORD, _with_highest(index, subs))


def array(index: int, name: str, *subs: Entry) -> Object:
    """As `record`, with values of one type."""
    return Object(index, name, Code.ARRAY, _with_highest(index, subs))


def _with_highest(index: int, subs: tuple[Entry, ...]) -> tuple[Entry, ...]:
    if subs[0].sub != 0:
        subs = (sub(0, "Highest sub-index supported", Type.UNSIGNED8, "const", subs[-1].sub), *subs)
    return tuple(msgspec.structs.replace(s, index=index) for s in subs)
