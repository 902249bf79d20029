"""Where position, current and cycle counter stand in TPDO1, from the rig file's `pdo.feedback`."""

import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple

from protocols.errors import ConfigError
from protocols.pdo import Mapped

POSITION, CURRENT, COUNTER = 0x6064, 0x6078, 0x2001
_CODES = {POSITION: "i", CURRENT: "h", COUNTER: "H"}  # CiA 402-2: INTEGER32, INTEGER16; 0x2001 is UNSIGNED16


class Reader(NamedTuple):
    """How a TPDO1 is read.

    Attributes:
        size: Its length in bytes.
        counted: It carries the drive's cycle counter.
        values: Position, current, counter of its bytes (0 where it carries none).
    """

    size: int
    counted: bool
    values: Callable[[bytes], tuple[int, int, int]]


def reader(layout: Sequence[str]) -> Reader:
    """Reader of a layout such as `("6064:0/32", "6078:0/16", "2001:0/16")`; other objects are passed over.

    Raises:
        ConfigError: An entry that cannot be read, or no position or current in it.
    """
    code, found = "<", []
    for entry in layout:
        mapped = Mapped.parse(entry)
        known = _CODES.get(mapped.index)
        if known is None:
            code += f"{mapped.bits // 8}x"
        elif mapped.bits != 8 * struct.calcsize(known):
            raise ConfigError(f"pdo.feedback: {entry} must have {8 * struct.calcsize(known)} bits.")
        else:
            code += known
            found.append(mapped.index)
    for index, what in ((POSITION, "position"), (CURRENT, "current")):
        if index not in found:
            bits = 8 * struct.calcsize(_CODES[index])
            raise ConfigError(f"pdo.feedback has no {what}, which a recording needs. Add {index:04X}:0/{bits}.")
    unpack = struct.Struct(code).unpack
    size = struct.calcsize(code)
    if found == [POSITION, CURRENT, COUNTER]:
        return Reader(size, True, unpack)
    order = [found.index(i) if i in found else None for i in (POSITION, CURRENT, COUNTER)]

    def values(data: bytes) -> tuple[int, int, int]:
        raw = unpack(data)
        position, current, counter = (0 if i is None else raw[i] for i in order)
        return position, current, counter

    return Reader(size, COUNTER in found, values)
