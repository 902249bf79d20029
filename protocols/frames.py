"""Classical CAN frames: value, public *virtualcan* wire format, exact length in bits, bus load.

The wire format is that of the `virtualcan` server, which independent CANopen masters already speak:
u32be length (14) | u32be identifier with the SocketCAN flag bits | u8 flags | u8 dlc | 8 data bytes.
Nobody else uses the flags; on the way to our hub they say which of several controllers behind one client sends, so that
a true bus can let them contend and count their errors apart. The hub clears them.
"""

import struct
from collections.abc import Iterable, Iterator
from functools import lru_cache
from itertools import repeat

import msgspec

EXTENDED = 0x8000_0000  # CAN_EFF_FLAG: 29-bit identifier
REMOTE = 0x4000_0000  # CAN_RTR_FLAG
ERROR = 0x2000_0000  # CAN_ERR_FLAG: the frame reports an error seen by the controller
ID_MASK = 0x1FFF_FFFF
MAX_DATA = 8
INTERMISSION_BITS = 3  # between two frames

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


def encode(frames: Iterable[Frame], stations: Iterable[int] = repeat(0)) -> bytes:
    """Virtualcan bytes of `frames`, ready for one `send`.

    Args:
        stations: For each frame the controller that sends it, 0 to 255.
    """
    pairs = zip(frames, stations, strict=False)
    return b"".join([_WIRE.pack(_WIRE_BODY, f.can_id, s, f.dlc or len(f.data), f.data) for f, s in pairs])


def decode(buffer: bytes | bytearray | memoryview) -> Iterator[Frame]:
    """Frames of whole wire records.

    Args:
        buffer: A multiple of `WIRE_BYTES` bytes.

    Raises:
        ValueError: A record's length field is not 14, or its DLC exceeds 8: the peer does not speak virtualcan.
    """
    for _, frame in decode_numbered(buffer):
        yield frame


def decode_numbered(buffer: bytes | bytearray | memoryview) -> Iterator[tuple[int, Frame]]:
    """As `decode`, each frame with its station."""
    for length, can_id, station, dlc, data in _WIRE.iter_unpack(buffer):
        if length != _WIRE_BODY or dlc > MAX_DATA:
            raise ValueError(f"not a virtualcan record: length {length} (14 expected), dlc {dlc} (at most 8)")
        if can_id & REMOTE:
            yield station, Frame(can_id, b"", dlc)
        else:
            yield station, Frame(can_id, data[:dlc])


# --- length on the wire ---

_CRC15 = 0x4599
_TAIL_BITS = 1 + 1 + 1 + 7 + INTERMISSION_BITS  # CRC delimiter, ACK slot, ACK delimiter, EOF: never stuffed


def _crc(crc: int, value: int, count: int) -> int:
    """CRC after `count` more bits, the highest of `value` first."""
    for k in range(count - 1, -1, -1):
        top = crc >> 14 ^ value >> k & 1
        crc = crc << 1 & 0x7FFF ^ (_CRC15 if top else 0)
    return crc


def _stuff(state: int, value: int, count: int) -> int:
    """Stuffing state after `count` more bits.

    Args:
        state: 16 x stuff bits so far + 8 x last bit + length of its run (0 before the first bit).
    """
    stuffed, last, run = state >> 4, state >> 3 & 1, state & 7
    for k in range(count - 1, -1, -1):
        bit = value >> k & 1
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:  # a complementary bit follows and starts a run of its own
            stuffed, last, run = stuffed + 1, 1 - bit, 1
    return stuffed << 4 | last << 3 | run


# A frame's length is wanted a dozen thousand times a second: bytes go through tables, headers are remembered.
_CRC_BYTE = [_crc(byte << 7, 0, 8) for byte in range(256)]
_STUFF_BYTE = [[_stuff(state, byte, 8) for byte in range(256)] for state in range(16)]
_STUFF_7 = [[_stuff(state, value, 7) for value in range(128)] for state in range(16)]


@lru_cache(maxsize=4096)
def _header(can_id: int, dlc: int) -> tuple[int, int, int]:
    """Start of frame to the DLC (ISO 11898-1): bits, CRC and stuffing state."""
    rtr = 1 if can_id & REMOTE else 0
    ident = can_id & ID_MASK
    if can_id & EXTENDED:
        text = f"0{ident >> 18:011b}11{ident & 0x3FFFF:018b}{rtr}00{dlc:04b}"
    else:
        text = f"0{ident:011b}{rtr}00{dlc:04b}"
    value, count = int(text, 2), len(text)
    return count, _crc(0, value, count), _stuff(0, value, count)


def bit_length(frame: Frame) -> int:
    """Bits the frame occupies on the bus, with its own stuff bits and the interframe space (ISO 11898-1)."""
    data = frame.data
    count, crc, state = _header(frame.can_id, frame.dlc or len(data))
    stuffed = 0
    for byte in data:
        crc = (crc << 8 & 0x7FFF) ^ _CRC_BYTE[crc >> 7 ^ byte]
        stuffed += state >> 4
        state = _STUFF_BYTE[state & 15][byte]
    stuffed += state >> 4
    state = _STUFF_BYTE[state & 15][crc >> 7]
    stuffed += state >> 4
    state = _STUFF_7[state & 15][crc & 127]
    return count + 8 * len(data) + 15 + stuffed + (state >> 4) + _TAIL_BITS


def priority(can_id: int) -> int:
    """Rank in arbitration, the lowest wins: identifier, RTR and IDE bits in the order they are sent (ISO 11898-1)."""
    remote = 1 if can_id & REMOTE else 0
    ident = can_id & ID_MASK
    if can_id & EXTENDED:  # SRR and IDE are recessive
        return (ident >> 18) << 21 | 3 << 19 | (ident & 0x3FFFF) << 1 | remote
    return ident << 21 | remote << 20


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
