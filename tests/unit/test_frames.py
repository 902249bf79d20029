"""CAN frames: wire format and length on the bus."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocols import frames
from protocols.frames import EXTENDED, REMOTE, Frame

any_frame = st.one_of(
    st.builds(Frame, st.integers(0, 0x7FF), st.binary(max_size=8)),
    st.builds(Frame, st.integers(0, 0x1FFFFFFF).map(lambda i: i | EXTENDED), st.binary(max_size=8)),
    st.builds(Frame, st.integers(0, 0x7FF).map(lambda i: i | REMOTE), st.just(b""), st.integers(0, 8)),
)


@given(st.lists(any_frame, max_size=5))
def test_wire_format_keeps_every_frame(sent: list[Frame]) -> None:
    assert list(frames.decode(frames.encode(sent))) == sent


def test_wire_format_is_the_public_virtualcan_record() -> None:
    # u32be length 14, u32be id, flags, dlc, 8 data bytes
    assert frames.encode([Frame(0x181, b"\x01\x02")]).hex() == "0000000e0000018100020102000000000000"


def test_a_foreign_protocol_is_refused() -> None:
    with pytest.raises(ValueError, match="length 1195725856 \\(14 expected\\)"):
        list(frames.decode(b"GET / HTTP/1.1\r\n\r\n"))


@pytest.mark.parametrize(
    ("size", "extended", "worst"),
    [(0, False, 55), (1, False, 65), (8, False, 135), (8, True, 160)],  # Davis et al. 2007, table of C_m in bit times
)
def test_worst_case_is_the_literatures(size: int, extended: bool, worst: int) -> None:
    assert frames.worst_case_bits(size, extended=extended) == worst


def test_length_of_a_frame_worked_out_by_hand() -> None:
    # Identifier 0x555 alternates and data 0x55 alternate: from the start of frame to the data no run of five but
    # the zeros of RTR, IDE, r0 and the DLC (0001): 1 0 0 0 0 0 0 1 has one stuff bit after the fifth zero.
    plain = 1 + 11 + 1 + 1 + 1 + 4 + 8 + 15 + 13
    crc_stuffing = frames.bit_length(Frame(0x555, b"\x55")) - plain - 1
    assert 0 <= crc_stuffing <= 3  # the CRC alone decides the rest


@given(any_frame)
def test_length_lies_between_nominal_and_worst_case(frame: Frame) -> None:
    extended = bool(frame.can_id & EXTENDED)
    worst = frames.worst_case_bits(len(frame.data), extended=extended)
    nominal = (67 if extended else 47) + 8 * len(frame.data)
    assert nominal <= frames.bit_length(frame) <= worst


def test_all_zero_frames_are_the_most_stuffed_bodies() -> None:
    assert frames.bit_length(Frame(0, bytes(8))) > frames.bit_length(Frame(0x555, b"\x55" * 8))


def test_bus_arithmetic_of_six_drives_at_1_khz() -> None:
    tpdo = [(8, 1000.0)] * 6 + [(1, 1000.0)]
    assert frames.bus_load(tpdo, 1_000_000) == pytest.approx(0.875)
    assert frames.bus_load(tpdo + [(8, 1000.0)] * 6, 1_000_000) == pytest.approx(1.685)


def longhand(frame: Frame) -> int:
    """Length of a frame as a person would write it: every bit, the CRC by long division, then stuffing."""
    dlc, ident, rtr = frame.dlc or len(frame.data), frame.can_id & frames.ID_MASK, int(bool(frame.can_id & REMOTE))
    if frame.can_id & EXTENDED:
        text = f"0{ident:029b}"[:12] + "11" + f"{ident:029b}"[11:] + f"{rtr}00{dlc:04b}"
    else:
        text = f"0{ident:011b}{rtr}00{dlc:04b}"
    text += "".join(f"{byte:08b}" for byte in frame.data)
    rest = int(text + "0" * 15, 2)
    divisor = 0b1100010110011001  # x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1
    for shift in range(len(text) - 1, -1, -1):
        if rest >> (shift + 15) & 1:
            rest ^= divisor << shift
    sent = ""
    for bit in f"{text}{rest:015b}":
        sent += bit
        if sent[-5:] in {"00000", "11111"}:
            sent += "1" if bit == "0" else "0"
    return len(sent) + 13  # CRC delimiter, ACK slot and delimiter, seven of EOF, three of intermission


@given(any_frame)
def test_length_is_that_of_the_bits_written_out(frame: Frame) -> None:
    assert frames.bit_length(frame) == longhand(frame)


def test_all_zero_feedback_is_as_long_as_was_measured() -> None:
    assert frames.bit_length(Frame(0x181, bytes(8))) == 126  # by an encoder of its own


@given(any_frame, any_frame)
def test_priority_is_the_order_of_the_bits_sent(one: Frame, other: Frame) -> None:
    """Dominant is 0: of two frames, the one with the first 0 where they differ wins."""

    def arbitration(frame: Frame) -> str:
        ident, rtr = frame.can_id & frames.ID_MASK, "1" if frame.can_id & REMOTE else "0"
        if frame.can_id & EXTENDED:
            return f"{ident >> 18:011b}11{ident & 0x3FFFF:018b}{rtr}"
        return f"{ident:011b}{rtr}0"

    first, second = sorted((one, other), key=lambda f: frames.priority(f.can_id))
    assert arbitration(first).ljust(32, "0") <= arbitration(second).ljust(32, "0")
