"""Every bus passes one suite: what is sent arrives once, in order, at everyone else, and at nobody's own ear."""

import contextlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import can
import pytest

from daq.bus import Listener, open_listener, wait_any
from emulator.bus import FrameBus, open_bus, receive_any
from emulator.hub import Hub
from protocols.clock import RealClock
from protocols.errors import PeerError
from protocols.frames import EXTENDED, REMOTE, Frame
from protocols.rig import Bus

DEADLINE_S = 5.0
NO_VCAN = pytest.mark.skipif(
    not Path("/sys/class/net/vcan0").exists(), reason="no vcan0: ip link add vcan0 type vcan && ip link set vcan0 up"
)
KINDS = [
    "hub over tcp",
    "hub over unix socket",
    "python-can virtual",
    pytest.param("socketcan", marks=[pytest.mark.vcan, NO_VCAN]),
]


@dataclass
class Wire:
    """A bus under test, who serves it, and who has joined."""

    config: Bus
    served: contextlib.ExitStack | None
    joined: contextlib.ExitStack

    def device(self) -> FrameBus:
        bus = open_bus(self.config)
        self.joined.callback(bus.close)
        return bus

    def listener(self) -> Listener:
        return self.joined.enter_context(open_listener(self.config, RealClock()))


@pytest.fixture(params=KINDS)
def wire(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Wire]:
    with contextlib.ExitStack() as served, contextlib.ExitStack() as joined:
        if request.param == "python-can virtual":
            yield Wire(Bus(name="can0", interface="virtual", channel=request.node.name), None, joined)
        elif request.param == "socketcan":
            yield Wire(Bus(name="can0", interface="socketcan", channel="vcan0"), None, joined)
        else:
            channel = "127.0.0.1:0" if request.param == "hub over tcp" else f"unix:{tmp_path}/can0"
            hub = served.enter_context(Hub([("can0", channel)]))
            thread = threading.Thread(target=hub.run)
            thread.start()
            served.callback(thread.join)
            served.callback(hub.stop)
            yield Wire(Bus(name="can0", channel=hub.channels["can0"]), served, joined)


def hear(bus: FrameBus | Listener, timeout_s: float) -> list[Frame]:
    """What arrives next; empty when the bus stays silent."""
    clock = RealClock()
    while True:  # a bus without a descriptor is only looked at for a moment
        batch = receive_any([bus], timeout_s)[0] if isinstance(bus, FrameBus) else wait_any([bus], timeout_s)[0]
        if batch or clock.now_ns() >= timeout_s * 1e9:
            return [f if isinstance(f, Frame) else f[1] for f in batch]


def collect(bus: FrameBus | Listener, count: int) -> list[Frame]:
    """The next `count` frames, or fewer when the bus stays silent."""
    frames: list[Frame] = []
    while len(frames) < count and (batch := hear(bus, DEADLINE_S)):
        frames += batch
    return frames


def together(wire: Wire, *buses: FrameBus | Listener) -> None:
    """Return once every bus is known to hear: joining a hub is not finished when `connect` returns."""
    with open_bus(wire.config) as probe:
        waiting = list(buses)
        while waiting:
            probe.send([Frame(0x7FF)])
            waiting = [bus for bus in waiting if not hear(bus, 0.01)]
        probe.send([Frame(0x7FE)])
        for bus in buses:
            while Frame(0x7FE) not in hear(bus, DEADLINE_S):
                pass


def test_frames_arrive_unchanged_at_every_other(wire: Wire) -> None:
    sender, first, second = wire.device(), wire.device(), wire.device()
    together(wire, first, second)
    frames = [
        Frame(0x000, b"\x01\x05"),
        Frame(0x181, bytes(range(8))),
        Frame(0x7FF, b""),
        Frame(0x12345678 | EXTENDED, b"\xff"),
        Frame(0x705 | REMOTE, b"", 1),
        Frame(0x706 | REMOTE, b"", 0),
    ]
    sender.send(frames)
    assert collect(first, len(frames)) == frames
    assert collect(second, len(frames)) == frames


def test_nobody_hears_itself(wire: Wire) -> None:
    sender, other = wire.device(), wire.device()
    together(wire, sender, other)
    sender.send([Frame(0x101)])
    assert collect(other, 1) == [Frame(0x101)]
    other.send([Frame(0x102)])  # arrives after any echo of 0x101 would have
    assert collect(sender, 1) == [Frame(0x102)]


def test_ten_thousand_frames_keep_order_without_loss(wire: Wire) -> None:
    """Two senders at once, bursts of 7: each sender's own order is kept, and a listener misses nothing."""
    senders = [wire.device(), wire.device()]
    listener = wire.listener()
    together(wire, *senders, listener)

    def send(number: int) -> None:
        for n in range(0, 5005, 7):
            senders[number].send([Frame(0x180 + number, (n + k).to_bytes(4, "big")) for k in range(7)])

    threads = [threading.Thread(target=send, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    frames = collect(listener, 2 * 5005)
    for thread in threads:
        thread.join()
    for number in range(2):
        counts = [int.from_bytes(f.data, "big") for f in frames if f.can_id == 0x180 + number]
        assert counts == list(range(5005))


def test_stamps_of_a_listener_never_go_back(wire: Wire) -> None:
    sender, listener = wire.device(), wire.listener()
    heard: list[tuple[int, Frame]] = []
    while len(heard) < 20:
        sender.send([Frame(0x80), Frame(0x181)])
        heard += wait_any([listener], 0.05)[0]
    stamps = [t for t, _ in heard]
    assert stamps == sorted(stamps)
    assert stamps[0] > 0


def test_a_listener_cannot_send(wire: Wire) -> None:
    listener = wire.listener()
    assert not [name for name in dir(listener) if "send" in name or "write" in name]


def test_silence_is_an_empty_list(wire: Wire) -> None:
    bus, listener = wire.device(), wire.listener()
    bus.send([])
    assert bus.receive() == []
    assert receive_any([bus], 0.01) == [[]]
    assert listener.receive() == []
    assert wait_any([listener], 0.01) == [[]]


def test_waiting_for_several_gives_each_its_own(wire: Wire) -> None:
    sender, first, quiet = wire.device(), wire.device(), wire.device()
    together(wire, sender, first, quiet)
    sender.send([Frame(0x181)])
    assert receive_any([sender], 0.01) == [[]]
    heard = [[], []]
    while not all(heard):
        heard = [kept + new for kept, new in zip(heard, receive_any([first, quiet], DEADLINE_S), strict=True)]
    assert heard == [[Frame(0x181)], [Frame(0x181)]]


def test_leaving_disturbs_nobody(wire: Wire) -> None:
    sender, stays, leaves = wire.device(), wire.device(), wire.device()
    together(wire, stays, leaves)
    sender.send([Frame(0x101)])
    leaves.close()
    sender.send([Frame(0x102)])
    assert collect(stays, 2) == [Frame(0x101), Frame(0x102)]


def test_a_bus_that_goes_away_while_one_waits_is_an_error_with_its_name(wire: Wire) -> None:
    if wire.served is None:
        pytest.skip("no hub to stop: the wire is this process' or the kernel's")
    bus = wire.device()
    together(wire, bus)
    outcome: list[BaseException] = []

    def read() -> None:
        try:
            receive_any([bus], DEADLINE_S)
        except PeerError as error:
            outcome.append(error)

    reader = threading.Thread(target=read)
    reader.start()
    wire.served.close()
    reader.join()
    assert "bus can0" in str(outcome[0])
    assert "is gone" in str(outcome[0])
    assert "Start it again" in str(outcome[0])


def test_python_can_programs_join(wire: Wire) -> None:
    """A program that knows only python-can, with its filters and notifier, on the same wire."""
    device = wire.device()
    with can.Bus(wire.config.channel, wire.config.interface, can_filters=[{"can_id": 0x181, "can_mask": 0x7FF}]) as bus:
        heard = can.BufferedReader()
        notifier = can.Notifier(bus, [heard], timeout=0.05)
        message = None
        while message is None:
            device.send([Frame(0x080, b"\x01"), Frame(0x181, b"\x2a")])
            message = heard.get_message(0.05)
        assert (message.arbitration_id, bytes(message.data)) == (0x181, b"\x2a")
        assert message.timestamp > 0
        bus.send(can.Message(arbitration_id=0x605, data=[1, 2, 3], is_extended_id=False))
        assert collect(device, 1) == [Frame(0x605, b"\x01\x02\x03")]
        notifier.stop()
