"""The raw SocketCAN reader without a kernel that has CAN: its structures, stamps and what becomes of its counters."""

import socket
import struct
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.bus import open_listener
from daq.rawcan import (
    SO_RXQ_OVFL,
    SO_TIMESTAMPING,
    Ancillary,
    RawSocket,
    RunTime,
    has_clock,
    parse_ancillary,
    parse_frame,
)
from daq.recorder import Recorder, Summary
from daq.shell import Writer, record
from protocols.clock import Clock, RealClock
from protocols.errors import PeerError
from protocols.frames import ERROR, EXTENDED, REMOTE, Frame
from protocols.recording import read_recording
from protocols.rig import Bus, load_rig

S = 1_000_000_000
DATE = 1_790_000_000 * S


@pytest.mark.parametrize(
    ("raw", "frame"),
    [  # as a kernel hands them out: identifier, length, three bytes of nothing, eight of data
        ("81010000 02 000000 0102 aabbccddeeff", Frame(0x181, b"\x01\x02")),
        ("78563492 00 000000 0000000000000000", Frame(0x12345678 | EXTENDED)),
        ("05070040 01 000000 0000000000000000", Frame(0x705 | REMOTE, b"", 1)),
        ("40000020 08 000000 0000000000000000", Frame(0x40 | ERROR, bytes(8))),
    ],
)
def test_frames_as_the_kernel_writes_them(raw: str, frame: Frame) -> None:
    assert parse_frame(bytes.fromhex(raw)) == frame


def test_what_is_no_classical_frame_is_refused() -> None:
    with pytest.raises(ValueError, match="72 bytes are no classical CAN frame \\(16 expected\\)"):
        parse_frame(bytes(72))


def test_control_messages() -> None:
    stamps = struct.pack("@6q", 1_790_000_000, 5, 0, 0, 12, 7)
    messages = [
        (socket.SOL_SOCKET, SO_RXQ_OVFL, struct.pack("@I", 489)),
        (socket.SOL_SOCKET, SO_TIMESTAMPING, stamps),
        (socket.SOL_SOCKET, 99, b"?"),
        (101, SO_RXQ_OVFL, struct.pack("@I", 3)),  # another protocol's
        (socket.SOL_SOCKET, SO_TIMESTAMPING, b"short"),
    ]
    assert parse_ancillary(messages) == Ancillary(DATE + 5, 12 * S + 7, 489)
    assert parse_ancillary([]) == Ancillary(0, 0, None)


# --- stamps on the run's clock ---


def test_a_kernel_stamp_is_as_far_back_as_the_kernel_says() -> None:
    run_time = RunTime()
    assert run_time(Ancillary(DATE - 250_000, 0, None), DATE, 7 * S) == 7 * S - 250_000
    assert run_time(Ancillary(0, 0, None), DATE, 8 * S) == 8 * S  # a kernel without stamps


@given(st.lists(st.tuples(st.integers(-(10**13), 10**13), st.integers(0, 10**9)), max_size=30))
def test_whatever_the_date_does_stamps_never_go_back_nor_ahead(steps: list[tuple[int, int]]) -> None:
    run_time, now_ns, last_ns = RunTime(), 0, 0
    for shift_ns, pause_ns in steps:  # the date jumps between the frame's arrival and the moment it is read
        now_ns += pause_ns
        t_ns = run_time(Ancillary(DATE + now_ns + shift_ns, 0, None), DATE + now_ns, now_ns)
        assert last_ns <= t_ns <= now_ns
        last_ns = t_ns


def test_hardware_stamps_keep_the_interfaces_own_spacing() -> None:
    """The kernel is late by 20 us to 5 ms, the interface's clock runs 50 ppm fast and began somewhere."""
    run_time, error_ns = RunTime(), []
    for n in range(1, 5000):
        true_ns = n * 1_000_000
        hardware_ns = 123 * S + true_ns + true_ns // 20_000
        late_ns = 20_000 + (n * 7919 % 4999) * 1000
        t_ns = run_time(
            Ancillary(DATE + true_ns + late_ns, hardware_ns, None), DATE + true_ns + late_ns, true_ns + late_ns
        )
        error_ns.append(t_ns - true_ns)
    settled = error_ns[500:]
    assert max(settled) - min(settled) < 300_000  # of kernel stamps: five milliseconds
    assert 0 <= min(settled) < 100_000


# --- counters on their way into the recording ---


class Lossy:
    """A listener that loses frames, as a kernel counts them, and whose interface goes down and up."""

    name = "can0"
    stamps = "arrival stamps are invented"
    blind = True

    def __init__(self, stop: threading.Event) -> None:
        self._stop = stop
        self._reads = self._drops = 0
        self._remarks: list[str] = []

    def receive(self) -> list[tuple[int, Frame]]:
        self._reads += 1
        if self._reads == 2:
            self._drops = 5
            self._remarks.append("vcan0: Network is down; listening on")
        if self._reads == 4:
            self._drops = 489  # after the last frame: only asking tells
            self._stop.set()
        t_ns = self._reads * 1000
        feedback = struct.pack("<ihH", 0, 0, self._reads)
        return [(t_ns, Frame(0x80, bytes([self._reads]))), (t_ns, Frame(0x181, feedback))]

    def count_drops(self) -> int:
        return self._drops

    def take_remarks(self) -> list[str]:
        remarks, self._remarks = self._remarks, []
        return remarks

    def fileno(self) -> int:
        raise NotImplementedError

    def close(self) -> None: ...

    def __enter__(self) -> "Lossy":
        return self

    def __exit__(self, *_: object) -> None: ...


def recorded(path: Path, listener: object, stop: threading.Event) -> Summary:
    rig, robot = load_rig("emps-rig")
    writer = Writer(Recorder(path, rig, robot), ["can0"])
    writer.start()
    record(writer, [listener], RealClock(), stop)
    return writer.finish()


def test_losses_and_remarks_of_a_listener_are_in_the_recording(tmp_path: Path) -> None:
    stop = threading.Event()
    summary = recorded(tmp_path / "run.mcap", Lossy(stop), stop)
    assert summary.verdict == "GAPS(489)"
    assert summary.because == ("can0: 489 frames dropped by the receiver",)
    said = [(e.source, e.text) for e in read_recording(tmp_path / "run.mcap").events]
    assert ("can0", "arrival stamps are invented") in said
    assert ("can0", "vcan0: Network is down; listening on") in said
    assert [text for _, text in said if "were lost" in text][-1].endswith(
        "between kernel and recorder: it was too slow"
    )


# --- interfaces that are not there ---


def test_a_missing_interface_says_how_to_make_one() -> None:
    with pytest.raises(
        PeerError, match=r"bus can0 \(socketcan vcan77\) does not exist: .*ip link add dev vcan77 type vcan"
    ):
        RawSocket(Bus(name="can0", interface="socketcan", channel="vcan77"), RealClock())


def test_socketcan_goes_to_the_raw_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    class Opened:
        def __init__(self, bus: Bus, clock: Clock) -> None:
            self.name = bus.channel

    monkeypatch.setattr("daq.bus.RawSocket", Opened)
    assert open_listener(Bus(name="can0", interface="socketcan", channel="vcan0"), RealClock()).name == "vcan0"


def test_an_interface_without_a_clock_is_known() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        assert not has_clock(any_socket, "lo")
        assert not has_clock(any_socket, "nowhere")
