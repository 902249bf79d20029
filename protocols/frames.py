"""Classical CAN frames: value, public *virtualcan* wire format, exact length in bits, bus load.

The wire format is that of the `virtualcan` server, which independent CANopen masters already speak:
u32be length (14) | u32be identifier with the SocketCAN flag bits | u8 flags | u8 dlc | 8 data bytes.
"""

import struct
from collections.abc import Iterable, Iterator

import msgspec

EXTENDED = 0x8000_0000  # CAN_EFF_FLAG: 29-bit identifier
REMOTE = 0x4000_0000  # CAN_RTR_FLAG
ERROR = 0x2000_0000  # CAN_ERR_FLAG: the frame reports an error seen by the controller
ID_MASK = 0x1FFF_FFFF
MAX_DATA = 8

_WIRE = struct.Struct(">IIBB8s")
WIRE_BYTES = _WIRE.size
_WIRE_BODY = WIRE_BYTES - 4


class Frame(msgspec.Struct, frozen=True, gc=False):
    """One classical CAN frame.

    Attributes:
        can_id: Identifier with the SocketCAN flag bits `EXTENDED`, `REMOTE`, `ERROR`.
        data: 0 to 8 bytes; empty for remote frames.
        dlc: Data length code of a remote frame (the length it asks for); 0 otherwise.
    """

    can_id: int
    data: bytes = b""
    dlc: int = 0


def encode(frames: Iterable[Frame]) -> bytes:
    """Virtualcan bytes of `frames`, ready for one `send`."""
    return b"".join([_WIRE.pack(_WIRE_BODY, f.can_id, 0, f.dlc or len(f.data), f.data) for f in frames])


def decode(buffer: bytes | bytearray | memoryview) -> Iterator[Frame]:
    """Frames of whole wire records.

    Args:
        buffer: A multiple of `WIRE_BYTES` bytes.

    Raises:
        ValueError: A record's length field is not 14, or its DLC exceeds 8: the peer does not speak virtualcan.
    """
    for length, can_id, _flags, dlc, data in _WIRE.iter_unpack(buffer):
        if length != _WIRE_BODY or dlc > MAX_DATA:
            raise ValueError(f"not a virtualcan record: length {length} (14 expected), dlc {dlc} (at most 8)")
        if can_id & REMOTE:
            yield Frame(can_id, b"", dlc)
        else:
            yield Frame(can_id, data[:dlc])


# --- length on the wire ---

_CRC15 = 0x4599
_TAIL_BITS = 1 + 1 + 1 + 7 + 3  # CRC delimiter, ACK slot, ACK delimiter, EOF, interframe space: never stuffed


def _stuffable_bits(frame: Frame) -> list[int]:
    """Start of frame to the end of the CRC (ISO 11898-1), before stuffing."""
    rtr = 1 if frame.can_id & REMOTE else 0
    ident = frame.can_id & ID_MASK
    dlc = frame.dlc or len(frame.data)
    if frame.can_id & EXTENDED:
        text = f"0{ident >> 18:011b}11{ident & 0x3FFFF:018b}{rtr}00{dlc:04b}"
    else:
        text = f"0{ident:011b}{rtr}00{dlc:04b}"
    bits = [int(c) for c in text] + [(byte >> k) & 1 for byte in frame.data for k in range(7, -1, -1)]
    crc = 0
    for bit in bits:
        top = bit ^ (crc >> 14 & 1)
        crc = (crc << 1) & 0x7FFF
        if top:
            crc ^= _CRC15
    return bits + [(crc >> k) & 1 for k in range(14, -1, -1)]


def bit_length(frame: Frame) -> int:
    """Bits the frame occupies on the bus, with its own stuff bits and the interframe space (ISO 11898-1)."""
    bits = _stuffable_bits(frame)
    length, run, last = len(bits), 0, -1
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:  # a complementary bit follows and starts a run of its own
            length, run, last = length + 1, 1, 1 - bit
    return length + _TAIL_BITS


def worst_case_bits(data_bytes: int, *, extended: bool = False) -> int:
    """Largest `bit_length` of any frame with that many data bytes: one stuff bit per four after the first."""
    body = (54 if extended else 34) + 8 * data_bytes
    return body + (body - 1) // 4 + _TAIL_BITS


def bus_load(frames_per_second: Iterable[tuple[int, float]], bitrate: int) -> float:
    """Worst-case share of a bus that a traffic pattern occupies.

    Args:
        frames_per_second: Pairs (data bytes, rate in 1/s) of 11-bit frames.
        bitrate: [bit/s].

    Returns:
        Load; 1.0 is a full bus.
    """
    return sum(worst_case_bits(size) * rate for size, rate in frames_per_second) / bitrate
