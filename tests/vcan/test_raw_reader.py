"""The raw reader on a kernel's vcan, beside can-utils: what arrives, when, what is lost, what controllers report."""

import socket
import struct
import subprocess
import time
from collections.abc import Iterator

import pytest

from daq.rawcan import KERNEL_STAMPS, RawSocket
from emulator.bus import open_bus
from protocols.clock import RealClock
from protocols.errorframes import Class, State, decode, encode
from protocols.errors import PeerError
from protocols.frames import ERROR, EXTENDED, REMOTE, Frame
from protocols.rig import Bus

pytestmark = pytest.mark.vcan

BUS = Bus(name="can0", interface="socketcan", channel="vcan0")


def send(*texts: str) -> None:
    for text in texts:
        subprocess.run(["cansend", "vcan0", text], check=True)


@pytest.fixture
def reader() -> Iterator[RawSocket]:
    with RawSocket(BUS, RealClock()) as made:
        yield made


def frames(reader: RawSocket) -> list[Frame]:
    """All that is waiting."""
    heard = []
    while batch := reader.receive():
        heard += [frame for _, frame in batch]
    return heard


def test_every_kind_of_frame_as_cansend_sends_it(reader: RawSocket) -> None:
    send("181#0102030405060708", "7FF#", "000#8105", "12345678#FF", "705#R", "20000040#0000000000000000")
    assert frames(reader) == [
        Frame(0x181, bytes(range(1, 9))),
        Frame(0x7FF),
        Frame(0x000, b"\x81\x05"),
        Frame(0x12345678 | EXTENDED, b"\xff"),
        Frame(0x705 | REMOTE, b"", 0),
        Frame(0x40 | ERROR, bytes(8)),
    ]


def test_stamps_are_the_kernels_and_lie_where_they_must() -> None:
    clock = RealClock()
    with RawSocket(BUS, clock) as reader:
        assert reader.stamps == KERNEL_STAMPS
        moments = []
        for _ in range(5):
            begin_ns = clock.now_ns()
            send("181#01")
            moments.append((begin_ns, clock.now_ns()))
            time.sleep(0.02)
        late_ns = clock.now_ns()
        stamps = [t_ns for t_ns, _ in reader.receive()]
    tolerance_ns = 1_000_000  # the date and the run's clock are read one after the other
    assert all(a - tolerance_ns <= t <= b + tolerance_ns for t, (a, b) in zip(stamps, moments, strict=True))
    assert stamps[0] < late_ns - 80_000_000  # not the moment of reading


def test_what_the_kernel_drops_is_counted_to_the_frame(reader: RawSocket) -> None:
    """Two sockets, one with a buffer of 4 KiB; nobody reads while 3000 frames pass. Sent = received + dropped."""
    with RawSocket(BUS, RealClock(), 4096) as narrow:
        subprocess.run(["cangen", "vcan0", "-g", "0", "-n", "3000", "-I", "i", "-L", "8"], check=True)
        before = frames(narrow)
        assert 0 < len(before) < 100
        assert narrow.count_drops() == 3000 - len(before)  # asked for (SO_MEMINFO)
        send("7FF#")
        assert frames(narrow) == [Frame(0x7FF)]
        assert narrow.dropped == 3000 - len(before)  # told with the next frame (SO_RXQ_OVFL)
    assert len(frames(reader)) == 3001
    assert reader.count_drops() == 0  # negative control: the wide one has lost nothing


def test_an_interface_that_goes_down_and_up_is_remarked_and_heard_again(reader: RawSocket) -> None:
    send("101#")
    assert frames(reader) == [Frame(0x101)]
    with open_bus(BUS) as device:
        subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
        try:
            with pytest.raises(PeerError, match="bus can0 .* is lost: .*Network is down"):
                device.send([Frame(0x181)])
        finally:
            subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)
    assert frames(reader) == []
    assert reader.take_remarks() == ["vcan0: Network is down; listening on"]
    assert reader.take_remarks() == []
    send("102#")
    assert frames(reader) == [Frame(0x102)]


def test_an_interface_that_is_taken_away_is_lost() -> None:
    subprocess.run(["ip", "link", "add", "vcan9", "type", "vcan"], check=True)
    subprocess.run(["ip", "link", "set", "vcan9", "up"], check=True)
    with RawSocket(Bus(name="can9", interface="socketcan", channel="vcan9"), RealClock()) as reader:
        subprocess.run(["ip", "link", "del", "vcan9"], check=True)
        with pytest.raises(PeerError, match=r"bus can9 \(socketcan vcan9\) is lost: "):
            for _ in range(3):
                reader.receive()


def test_our_error_frames_are_the_kernels(reader: RawSocket) -> None:
    """What the emulated bus says about a controller, through a kernel and back."""
    sent = [encode(Class.BUS_OFF, tec=255, rec=3), encode(Class.RESTARTED, tec=0)]
    with open_bus(BUS) as device:
        device.send(sent)
    heard = frames(reader)
    assert heard == sent
    assert [decode(f).state for f in heard] == [State.BUS_OFF, State.ACTIVE]


def test_can_fd_is_not_let_in(reader: RawSocket) -> None:
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as other:
        other.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        other.bind(("vcan0",))
        try:
            other.send(struct.pack("=IBBxx64s", 0x123, 64, 0, bytes(64)))
        except OSError:
            pytest.skip("this vcan has the MTU of classical CAN: FD frames cannot even be sent")
    send("181#")
    assert frames(reader) == [Frame(0x181)]
