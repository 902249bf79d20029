"""The text of `candump -L`: one frame a line, `(0.001000) can0 181#0102030405060708`.

What can-utils, Wireshark and others read and write; a pipe of it joins emulator and recorder in simulated time.
"""

import re

from protocols.errors import DataError
from protocols.frames import ERROR, EXTENDED, ID_MASK, REMOTE, Frame

_LARGEST_SHORT = 0x7FF
_LONG_DIGITS = 8  # identifiers of 29 bits, and error frames with their flag
_LINE = re.compile(
    r"\s*\(([0-9]+)\.([0-9]{1,9})\)\s+(\S+)\s+([0-7][0-9A-Fa-f]{2}|[0-9A-Fa-f]{8})#"
    r"([0-9A-Fa-f]{0,16}|R[0-8]?)(?:\s+[RT])?\s*"  # newer candump -x appends received or transmitted
)


def format_frame(t_ns: int, bus: str, frame: Frame) -> str:
    """Line of a frame, without the line end.

    Args:
        t_ns: Stamp [ns]; the text keeps whole microseconds.
    """
    can_id = frame.can_id
    stamp = f"({t_ns // 1_000_000_000}.{t_ns // 1000 % 1_000_000:06d}) {bus} "
    if can_id <= _LARGEST_SHORT:
        return f"{stamp}{can_id:03X}#{frame.data.hex().upper()}"
    if can_id & ERROR:
        return f"{stamp}{can_id & (ID_MASK | ERROR):08X}#{frame.data.hex().upper()}"
    shown = f"{can_id & ID_MASK:08X}" if can_id & EXTENDED else f"{can_id & ID_MASK:03X}"
    if can_id & REMOTE:
        return f"{stamp}{shown}#R{frame.dlc or ''}"
    return f"{stamp}{shown}#{frame.data.hex().upper()}"


def parse_line(text: str) -> tuple[int, str, Frame]:
    """Stamp [ns], bus and frame of a line.

    Raises:
        DataError: Not such a line; CAN FD frames are refused too.
    """
    match = _LINE.fullmatch(text)
    if match is None or (len(match[5]) % 2 and match[5][0] != "R"):
        raise DataError(
            f"{text.strip()[:80]!r} is not a frame as candump -L writes it."
            " Expected a line such as: (0.001000) can0 181#0102030405060708."
        )
    seconds, fraction, bus, ident, payload = match.groups()
    t_ns = int(seconds) * 1_000_000_000 + int(fraction.ljust(9, "0"))
    can_id = int(ident, 16)
    if len(ident) == _LONG_DIGITS:
        can_id = can_id & (ID_MASK | ERROR) if can_id & ERROR else can_id & ID_MASK | EXTENDED
    if payload[:1] == "R":
        return t_ns, bus, Frame(can_id | REMOTE, b"", int(payload[1:] or 0))
    return t_ns, bus, Frame(can_id, bytes.fromhex(payload))
