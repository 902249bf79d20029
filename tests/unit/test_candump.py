"""Candump text: golden lines as can-utils writes them, round trips, refusals."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocols.candump import format_frame, parse_line
from protocols.errors import DataError
from protocols.frames import ERROR, EXTENDED, ID_MASK, REMOTE, Frame

# Written by hand after lib.c of can-utils (sprint_canframe), 2020.11.
GOLDEN = [
    (Frame(0x181, bytes(range(1, 9))), "(1.000001) can0 181#0102030405060708"),
    (Frame(0x000, b"\x01\x05"), "(1.000001) can0 000#0105"),
    (Frame(0x080), "(1.000001) can0 080#"),
    (Frame(0x705 | REMOTE, b"", 0), "(1.000001) can0 705#R"),
    (Frame(0x705 | REMOTE, b"", 8), "(1.000001) can0 705#R8"),
    (Frame(0x00000001 | EXTENDED, b"\xab"), "(1.000001) can0 00000001#AB"),
    (Frame(0x1234 | EXTENDED | REMOTE, b"", 2), "(1.000001) can0 00001234#R2"),
    (Frame(0x040 | ERROR, bytes(8)), "(1.000001) can0 20000040#0000000000000000"),  # bus off
]


@pytest.mark.parametrize(("frame", "line"), GOLDEN)
def test_golden_lines(frame: Frame, line: str) -> None:
    assert format_frame(1_000_001_999, "can0", frame) == line
    assert parse_line(line) == (1_000_001_000, "can0", frame)


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    extended = draw(st.booleans())
    can_id = draw(st.integers(0, ID_MASK)) | EXTENDED if extended else draw(st.integers(0, 0x7FF))
    kind = draw(st.sampled_from(["data", "remote", "error"]))
    if kind == "remote":
        return Frame(can_id | REMOTE, b"", draw(st.integers(0, 8)))
    if kind == "error":
        return Frame(can_id & ID_MASK | ERROR, draw(st.binary(max_size=8)))
    return Frame(can_id, draw(st.binary(max_size=8)))


@given(frames(), st.integers(0, 2**62), st.sampled_from(["can0", "vcan1", "left-arm"]))
def test_round_trip(frame: Frame, t_ns: int, bus: str) -> None:
    assert parse_line(format_frame(t_ns, bus, frame)) == (t_ns // 1000 * 1000, bus, frame)


@pytest.mark.parametrize(
    ("line", "t_ns", "frame"),
    [
        ("(1436509052.249713) vcan0 044#2A366C2BBA\n", 1436509052_249713000, Frame(0x44, bytes.fromhex("2a366c2bba"))),
        (" (0.5)   vcan0   1ab#00 T\r\n", 500_000_000, Frame(0x1AB, b"\x00")),  # candump -x; other writers' spacing
        ("(12.345678901) vcan0 1AB#00", 12_345_678_901, Frame(0x1AB, b"\x00")),  # candump -L -N
    ],
)
def test_what_other_writers_write(line: str, t_ns: int, frame: Frame) -> None:
    assert parse_line(line) == (t_ns, "vcan0", frame)


@pytest.mark.parametrize(
    "line",
    [
        "",
        "hello",
        "(1.0) can0",
        "1.0 can0 181#00",
        "(1.0) can0 181",
        "(1.0) can0 18#00",
        "(1.0) can0 800#00",  # 12 bits
        "(1.0) can0 0x1#00",
        "(1.0) can0 1_8#00",
        "(1.0) can0 181#0",
        "(1.0) can0 181#R9",
        "(1.0) can0 181#010203040506070809",
        "(1.0) can0 181##1010203",  # CAN FD
        "(1.0) can0 181#00 T trailing",
        "(-1.0) can0 181#00",
        "(1.0) can0 181#0\N{ARABIC-INDIC DIGIT ONE}",
    ],
)
def test_anything_else_is_refused_and_shown(line: str) -> None:
    with pytest.raises(DataError) as refused:
        parse_line(line)
    assert str(refused.value).startswith(f"{line!r} is not a frame as candump -L writes it.")
    assert "(0.001000) can0 181#0102030405060708" in str(refused.value)


def test_a_monstrous_line_is_shown_in_part() -> None:
    with pytest.raises(DataError) as refused:
        parse_line("x" * 100_000)
    assert len(str(refused.value)) < 300
