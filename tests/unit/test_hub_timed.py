"""The hub with a wire in it: true time, arbitration, faults and error frames between real sockets."""

import socket
import threading
from collections.abc import Callable, Iterator

import pytest

from emulator.bus import FrameBus, open_bus, receive_any
from emulator.bustiming import served, wires
from emulator.channel import parse as address
from emulator.disturbance import Disturbance, Kind, parse
from emulator.hub import Hub
from emulator.hubprocess import HubProcess
from emulator.wire import Wire
from protocols.clock import RealClock
from protocols.errorframes import Class, State, decode
from protocols.errors import ConfigError
from protocols.frames import ERROR, Frame, bit_length, encode
from protocols.rig import Bus, load_rig

DEADLINE_S = 10.0
MS = 1_000_000
SLOW = 10_000  # bit/s: a frame takes a dozen milliseconds, far more than any scheduling delay


class Place:
    """A hub of one bus in a thread, and who is on it."""

    def __init__(self, wire: Wire) -> None:
        self.hub = Hub([("can0", "127.0.0.1:0")], {"can0": wire})
        self._thread = threading.Thread(target=self.hub.run)
        self._thread.start()
        self._joined: list[FrameBus] = []

    def join(self, nodes: tuple[int, ...] = ()) -> FrameBus:
        known = self.hub.counts["can0"].clients
        bus = open_bus(Bus(name="can0", channel=self.hub.channels["can0"]), nodes)
        while self.hub.counts["can0"].clients == known:
            pass
        self._joined.append(bus)
        return bus

    def close(self) -> None:
        self.hub.stop()
        self._thread.join()
        for bus in self._joined:
            bus.close()
        self.hub.close()


@pytest.fixture
def place() -> Iterator[Callable[[Wire], Place]]:
    made: list[Place] = []

    def make(wire: Wire) -> Place:
        made.append(Place(wire))
        return made[-1]

    yield make
    for one in made:
        one.close()


def collect(bus: FrameBus, count: int) -> list[Frame]:
    frames: list[Frame] = []
    while len(frames) < count and (batch := receive_any([bus], DEADLINE_S)[0]):
        frames += batch
    return frames


def test_frames_take_their_time(place) -> None:
    hub = place(Wire(SLOW))
    sender, listener = hub.join(), hub.join()
    frames = [Frame(0x181, bytes([n]) * 8) for n in range(10)]
    clock = RealClock()
    sender.send(frames)
    assert collect(listener, 10) == frames
    needed_ns = sum(map(bit_length, frames)) * 1_000_000_000 // SLOW - 3 * 1_000_000_000 // SLOW
    assert needed_ns <= clock.now_ns() < 2 * needed_ns
    assert hub.hub.traffic["can0"].frames == 10


def test_an_ideal_hub_takes_none(place) -> None:
    """Negative control: the same frames without a bit rate."""
    hub = place(Wire(None))
    sender, listener = hub.join(), hub.join()
    clock = RealClock()
    sender.send([Frame(0x181, bytes([n]) * 8) for n in range(10)])
    assert len(collect(listener, 10)) == 10
    assert clock.now_ns() < 100 * MS


def test_the_lowest_identifier_first_between_clients_the_given_order_within(place) -> None:
    hub = place(Wire(SLOW))
    host, drive, listener = hub.join(), hub.join(), hub.join()
    host.send([Frame(0x7FF, bytes(8)), Frame(0x301), Frame(0x080)])
    while hub.hub.counts["can0"].frames < 3:
        pass
    drive.send([Frame(0x181), Frame(0x100)])
    assert [f.can_id for f in collect(listener, 5)] == [0x7FF, 0x181, 0x100, 0x301, 0x080]


def test_drives_behind_one_client_contend_as_several(place) -> None:
    hub = place(Wire(SLOW))
    rig, listener = hub.join(nodes=(1, 2, 3)), hub.join()
    rig.send([Frame(0x183), Frame(0x182), Frame(0x181), Frame(0x703), Frame(0x081)])
    assert [f.can_id for f in collect(listener, 5)] == [0x181, 0x081, 0x182, 0x183, 0x703]


def test_one_client_is_one_queue(place) -> None:
    """Negative control."""
    hub = place(Wire(SLOW))
    rig, listener = hub.join(), hub.join()
    rig.send([Frame(0x183), Frame(0x182), Frame(0x181)])  # whatever their identifiers
    assert [f.can_id for f in collect(listener, 3)] == [0x183, 0x182, 0x181]


def test_station_numbers_stay_in_the_hub(place) -> None:
    hub = place(Wire(None))
    rig = hub.join(nodes=(1, 2, 3))
    family, where = address(hub.hub.channels["can0"])
    with socket.socket(family) as stranger:
        stranger.settimeout(DEADLINE_S)
        stranger.connect(where)
        while hub.hub.counts["can0"].clients < 2:
            pass
        rig.send([Frame(0x183, b"\1")])
        assert stranger.recv(100) == encode([Frame(0x183, b"\1")])


def test_drop_delay_duplicate(place) -> None:
    hub = place(Wire(None, disturbances=[Disturbance(Kind.DROP, "can0", left=3)]))
    sender, listener = hub.join(), hub.join()
    sender.send([Frame(0x181, bytes([n])) for n in range(5)])
    assert [f.data[0] for f in collect(listener, 2)] == [3, 4]
    hub.hub.disturb(Disturbance(Kind.DUPLICATE, "can0", left=1))
    hub.hub.disturb(Disturbance(Kind.DELAY, "can0", delay_ns=30 * MS, left=1))
    hub.hub.disturb(Disturbance(Kind.DROP, "elsewhere"))
    begin = RealClock()
    heard: list[Frame] = []
    while heard.count(Frame(0x182)) < 2:  # the hub hears of it a little after this thread said so
        sender.send([Frame(0x182)])
        heard += collect(listener, 1)
    assert begin.now_ns() >= 30 * MS
    assert hub.hub.traffic["can0"].dropped == 3


def test_errors_are_told_to_the_one_they_happen_to(place) -> None:
    """C1 on the hub: 32 bit errors, bus-off; back after the restart time, the queue is gone."""
    wire = Wire(None, 50 * MS, [Disturbance(Kind.CORRUPT, "can0", can_id=0x181, mask=0x7FF, left=32)])
    hub = place(wire)
    rig, listener = hub.join(nodes=(1, 2)), hub.join()
    rig.send([Frame(0x181), Frame(0x182)])
    told = collect(rig, 4)
    reports = [decode(f) for f in told]
    assert [r.state for r in reports] == [State.WARNING, State.PASSIVE, State.BUS_OFF, State.ACTIVE]
    assert reports[-1].classes & Class.RESTARTED
    assert {r.station for r in reports} == {1}
    rig.send([Frame(0x181, b"\7")])
    heard = collect(listener, 2)
    assert [f for f in heard if not f.can_id & ERROR] == [Frame(0x182), Frame(0x181, b"\7")]


def test_bus_off_of_the_whole_bus_is_heard_and_then_nothing_is(place) -> None:
    hub = place(Wire(None))
    sender, listener = hub.join(), hub.join()
    hub.hub.disturb(Disturbance(Kind.BUS_OFF, "can0", restart_ns=100 * MS))
    assert decode(collect(listener, 1)[0]).state is State.BUS_OFF
    sender.send([Frame(0x101)])
    assert decode(collect(listener, 1)[0]).classes & Class.RESTARTED
    sender.send([Frame(0x102)])
    assert collect(listener, 1) == [Frame(0x102)]
    assert hub.hub.traffic["can0"].lost == 1


def test_alone_a_client_waits_for_the_first_other(place) -> None:
    hub = place(Wire(1_000_000))
    first = hub.join()
    first.send([Frame(0x701, b"\0")])
    reports = [decode(f) for f in collect(first, 3)]
    assert "nobody else is on the bus" in reports[0].text
    assert reports[-1].state is State.PASSIVE
    second = hub.join()
    assert collect(second, 1) == [Frame(0x701, b"\0")]


def test_a_full_queue_is_counted_by_who_sent(place) -> None:
    """C11 on the hub: the controller reports the overflow, the sender counts the commands it lost and goes on."""
    hub = place(Wire(SLOW, queue_frames=10))
    sender, listener = hub.join(), hub.join()
    sender.send([Frame(0x301, bytes([n])) for n in range(13)])
    while sender.dropped < 3:
        receive_any([sender], DEADLINE_S)
    assert [f.data[0] for f in collect(listener, 10)] == list(range(10))
    assert sender.dropped == 3


def test_a_hub_in_its_own_process_takes_wires_and_orders() -> None:
    rig = load_rig("emps-rig")[0]
    with HubProcess([("can0", "127.0.0.1:0")], wires(rig, "true")) as hub:
        bus = Bus(name="can0", channel=hub.channels["can0"])
        with open_bus(bus) as one, open_bus(bus) as other:
            one.send([Frame(0x100)])
            assert Frame(0x100) in collect(other, 1)
            before = hub.traffic()["can0"]
            assert before.frames == 1
            assert before.busy_ns >= bit_length(Frame(0x100)) * 1000
            hub.disturb(parse("drop@can0:count=2", rig))
            one.send([Frame(0x101), Frame(0x102), Frame(0x103)])
            assert collect(other, 1) == [Frame(0x103)]
            assert hub.traffic()["can0"].dropped == 2


def test_ideal_buses_without_faults_need_no_wire() -> None:
    rig = load_rig("tx40-rig")[0]
    assert wires(rig, "ideal") == {}
    assert wires(rig, "ideal", ["heartbeat-loss@joint3"]) == {}
    assert list(wires(rig, "ideal", ["drop@can1"])) == ["can0", "can1"]
    assert list(served(rig, "true")) == ["can0", "can1"]


def test_timing_that_does_not_exist_and_buses_of_others_are_refused() -> None:
    rig = load_rig("emps-rig")[0]
    with pytest.raises(ConfigError, match="--bus-timing fast: choose ideal or true"):
        wires(rig, "fast")
    from msgspec.structs import replace

    kernel = replace(rig, bus=[replace(rig.bus[0], interface="socketcan", channel="vcan0")])
    assert served(kernel, "ideal") == {}
    for timing, faults in (("true", []), ("ideal", ["drop@can0"])):
        with pytest.raises(ConfigError, match="bus can0 is socketcan: its timing and faults are its own"):
            served(kernel, timing, faults)
