"""Buses that do not exist, are not what they seem, go away or stay full: what the user is told."""

import errno
import logging
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from daq.bus import open_listener
from emulator.bus import DROP_NS, GIVE_UP_NS, FrameBus, open_bus
from emulator.virtualcan import VirtualCanBus
from protocols.clock import RealClock, SimClock
from protocols.errors import ArmrigError, PeerError
from protocols.frames import ERROR, EXTENDED, REMOTE, Frame
from protocols.pythoncan import from_message, to_message
from protocols.rig import Bus

DEADLINE_S = 5.0


def refusal(bus: Bus) -> str:
    """What both the emulator and the acquisition say about it."""
    said = []
    for opener in (open_bus, lambda b: open_listener(b, RealClock())):
        with pytest.raises(PeerError) as refused:
            opener(bus)
        said.append(str(refused.value))
    assert said[0] == said[1]
    assert issubclass(PeerError, ArmrigError)
    assert PeerError.exit_code == 5
    return said[0]


def test_no_hub(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        channel = f"127.0.0.1:{listener.getsockname()[1]}"
    assert refusal(Bus(name="can0", channel=channel)) == (
        f"bus can0 (virtualcan {channel}) cannot be joined: no CAN hub answers at {channel}: Connection refused."
        " Start the emulator, which serves the hub, or correct the channel in the rig file."
    )
    assert "No such file or directory" in refusal(Bus(name="can0", channel=f"unix:{tmp_path}/can0"))


def test_no_address() -> None:
    assert "channel 'vcan0' is no address of a CAN hub: write HOST:PORT" in refusal(Bus(name="can0", channel="vcan0"))


def test_no_such_socketcan_interface() -> None:
    said = refusal(Bus(name="left", interface="socketcan", channel="vcan77"))
    assert said.startswith("bus left (socketcan vcan77) does not exist: ")
    assert "ip link add dev vcan77 type vcan && ip link set vcan77 up" in said
    assert "virtualcan, which needs no kernel support" in said


def test_no_such_interface() -> None:
    said = refusal(Bus(name="can0", interface="carrier-pigeon", channel="x"))
    assert "bus can0 (carrier-pigeon x): python-can offers no such interface" in said


# --- what answers is no hub ---


@pytest.fixture
def impostor() -> Iterator[tuple[Bus, socket.socket]]:
    """A TCP server and the bus that names it; the accepted side is the second value."""
    accepted: list[socket.socket] = []
    with socket.create_server(("127.0.0.1", 0)) as listener:
        bus = Bus(name="can0", channel=f"127.0.0.1:{listener.getsockname()[1]}")
        thread = threading.Thread(target=lambda: accepted.append(listener.accept()[0]))
        thread.start()
        client = open_bus(bus)
        thread.join()
        with accepted[0], client:
            yield client, accepted[0]


def wait_for_data(bus: FrameBus) -> list[Frame]:
    while not (frames := bus.receive()):
        pass
    return frames


def test_a_web_server_is_no_hub(impostor: tuple[FrameBus, socket.socket]) -> None:
    bus, peer = impostor
    peer.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
    with pytest.raises(PeerError, match="is not a CAN hub: not a virtualcan record: length 1213486160"):
        wait_for_data(bus)


def test_a_record_in_pieces_is_one_frame(impostor: tuple[FrameBus, socket.socket]) -> None:
    bus, peer = impostor
    record = bytes.fromhex("0000000e 00000181 00 02 0102000000000000")
    for byte in record:
        assert bus.receive() == []
        peer.sendall(bytes([byte]))
    assert wait_for_data(bus) == [Frame(0x181, b"\x01\x02")]


def test_a_hub_that_leaves(impostor: tuple[FrameBus, socket.socket]) -> None:
    bus, peer = impostor
    peer.close()
    with pytest.raises(PeerError, match=r"bus can0 .* is lost: the CAN hub at .* is gone: it closed the connection\."):
        wait_for_data(bus)
    with pytest.raises(PeerError, match="is lost"):
        while True:
            bus.send([Frame(0x80)])


def test_a_hub_that_does_not_read(impostor: tuple[FrameBus, socket.socket], monkeypatch: pytest.MonkeyPatch) -> None:
    bus, _ = impostor
    monkeypatch.setattr("emulator.virtualcan.WRITE_S", 0.05)
    with pytest.raises(PeerError, match="it has read nothing for"):
        while True:
            bus.send([Frame(0x181, bytes(8))] * 1000)


def test_messages_of_python_can_keep_everything() -> None:
    for frame in [
        Frame(0x181, bytes(range(8))),
        Frame(0x12345678 | EXTENDED, b"\x01"),
        Frame(0x705 | REMOTE, b"", 1),
        Frame(0x40 | ERROR, bytes(8)),
    ]:
        assert from_message(to_message(frame)) == frame
    assert to_message(Frame(0x181), 12.5).timestamp == 12.5


def test_the_interface_is_found_by_its_entry_point() -> None:
    with pytest.raises(can.CanInitializationError, match="no CAN hub answers at unix:nowhere"):
        can.Bus(interface="virtualcan", channel="unix:nowhere")
    assert VirtualCanBus in can.BusABC.__subclasses__()


# --- full transmit queues ---


class Choked(can.BusABC):
    """Refuses as SocketCAN does, as often as told."""

    def __init__(self, refusals: float, error: int = errno.ENOBUFS) -> None:
        self.refusals, self.error = refusals, error
        self.sent: list[int] = []
        super().__init__("choked")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.refusals > 0:
            self.refusals -= 1
            raise can.CanOperationError(f"Failed to transmit: {os.strerror(self.error)}", self.error)
        self.sent.append(msg.arbitration_id)


def choked_bus(interface: Choked) -> tuple[FrameBus, SimClock]:
    clock = SimClock()
    return FrameBus(Bus(name="can0", interface="socketcan", channel="vcan0"), interface, clock), clock


def test_a_queue_that_is_full_for_a_moment_costs_nothing() -> None:
    interface = Choked(refusals=3)
    bus, _ = choked_bus(interface)
    with bus:
        bus.send([Frame(0x201), Frame(0x202)])
    assert interface.sent == [0x201, 0x202]
    assert bus.dropped == 0


def test_a_queue_that_stays_full_costs_the_command(caplog: pytest.LogCaptureFixture) -> None:
    interface = Choked(refusals=DROP_NS // 1_000_000 + 1)
    bus, clock = choked_bus(interface)
    with bus, caplog.at_level(logging.WARNING, "armrig.bus"):
        bus.send([Frame(0x201), Frame(0x202)])
    assert interface.sent == [0x202]
    assert bus.dropped == 1
    assert clock.now_ns() == DROP_NS
    assert "bus can0: queue full; frame 201 dropped, 1 so far" in caplog.text


def test_a_bus_that_takes_nothing_for_a_second_is_lost() -> None:
    bus, clock = choked_bus(Choked(refusals=float("inf")))
    with bus, pytest.raises(PeerError, match="bus can0 .* is lost: .*No buffer space available"):
        bus.send([Frame(0x201)] * 1000)
    assert GIVE_UP_NS < clock.now_ns() < 1.1 * GIVE_UP_NS
    assert bus.dropped > 50


def test_an_interface_that_is_down_is_lost_at_once() -> None:
    bus, clock = choked_bus(Choked(refusals=1, error=errno.ENETDOWN))
    with bus, pytest.raises(PeerError, match="bus can0 .* is lost: .*Network is down"):
        bus.send([Frame(0x201)])
    assert clock.now_ns() == 0
