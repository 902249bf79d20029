"""PDOs of an emulated device: transmission types, events, requests, remapping, what is refused."""

import struct

import pytest

from protocols import nmt, pdo
from protocols.frames import REMOTE, Frame
from protocols.sdo import Abort

START, STOP = nmt.Command.START, nmt.Command.STOP


# --- PDOs ---


def test_transmission_types(bench) -> None:
    bench.remap(1, ["2001:0/16"], 3)
    bench.remap(3, ["6071:0/16"], 0)
    bench.nmt(START)
    sent = [[f.can_id for f in bench.sync()] for _ in range(6)]
    assert sent == [[0x385], [], [0x185], [], [], [0x185]]  # type 0: once at first, then after a change only
    bench.write(0x6071, 0, 5, 2)
    assert [f.can_id for f in bench.sync()] == [0x385]


@pytest.mark.parametrize("kind", [241, 251])
def test_transmission_types_that_are_refused(bench, kind: int) -> None:
    assert bench.refused(0x1800, 2, kind, 1) is Abort.VALUE


@pytest.mark.parametrize("kind", [252, 253])
def test_an_rpdo_cannot_be_asked_for(bench, kind: int) -> None:
    assert bench.refused(0x1400, 2, kind, 1) is Abort.VALUE


def ask(bench, cob_id: int) -> list[bytes]:
    """Data that a remote frame brings."""
    return [f.data for f in bench.send(cob_id | REMOTE) if f.can_id == cob_id]


def allow_rtr(bench, number: int) -> None:
    """Clear bit 30 of a TPDO's COB-ID."""
    cob_id = nmt.tpdo_id(number, bench.node)
    bench.write(0x1800 + number - 1, 1, 0x8000_0000 | cob_id, 4)
    bench.write(0x1800 + number - 1, 1, cob_id, 4)


def test_tpdo_sampled_on_sync_and_sent_on_request(bench) -> None:
    bench.remap(3, ["2001:0/16"], 252)
    allow_rtr(bench, 3)
    bench.nmt(START)
    assert ask(bench, 0x385) == []  # nothing sampled yet
    assert [f.can_id for f in bench.sync(3)] == [0x185] * 3
    assert ask(bench, 0x385) == [b"\3\0"] == ask(bench, 0x385)


def test_tpdo_sampled_and_sent_on_request(bench) -> None:
    bench.remap(3, ["6071:0/16"], 253)
    bench.nmt(START)
    bench.write(0x6071, 0, 7, 2)
    assert ask(bench, 0x385) == []  # bit 30 is still set: no remote frames
    allow_rtr(bench, 3)
    assert ask(bench, 0x385) == [b"\7\0"]
    bench.write(0x6071, 0, 8, 2)
    assert ask(bench, 0x385) == [b"\x08\0"]
    bench.nmt(STOP)
    assert ask(bench, 0x385) == []


def test_any_tpdo_may_be_asked_for(bench) -> None:
    allow_rtr(bench, 1)
    bench.nmt(START)
    bench.sync(5)
    assert ask(bench, 0x185) == [struct.pack("<ihH", 0, 0, 5)]


def test_sync_start_value(bench) -> None:
    bench.write(0x1019, 0, 10, 1)
    bench.remap(1, ["2001:0/16"], 1)
    bench.remap(3, ["2001:0/16"], 3)
    assert bench.refused(0x1800, 6, 4, 1) is Abort.STATE
    for index, cob_id in ((0x1800, 0x185), (0x1802, 0x385)):
        bench.write(index, 1, 0xC000_0000 | cob_id, 4)
        bench.write(index, 6, 4, 1)
        bench.write(index, 1, 0x4000_0000 | cob_id, 4)
    bench.nmt(START)
    sent = [sorted(f.can_id for f in bench.sync() if f.can_id != 0x285) for _ in range(7)]
    assert sent == [[], [], [], [0x185], [0x185], [0x185, 0x385], [0x185]]


def test_rpdo_deadline(bench, emergencies) -> None:
    bench.write(0x1401, 5, 20, 2)
    bench.nmt(START)
    assert emergencies(bench.wait(100)) == []  # watched from the first one on
    bench.target()
    assert emergencies(bench.wait(19)) == []
    assert emergencies(bench.wait(1)) == [(0x8250, 0x11)]
    assert emergencies(bench.target()) == [(0, 0)]


def test_synchronous_window(bench) -> None:
    bench.write(0x1007, 0, 300, 4)
    bench.nmt(START)
    bench.sync()
    bench.target(torque=5)
    bench.sync()
    assert bench.read_int(0x6071) == 5
    bench.t_ns += 400_000
    bench.target(torque=6)
    bench.sync()
    assert bench.read_int(0x6071) == 5


def test_event_driven_tpdo_with_inhibit_time(bench) -> None:
    bench.remap(3, ["6071:0/16"], 255, inhibit_100us=50)
    bench.nmt(START)
    frames = []
    for value in range(1, 8):
        bench.write(0x6071, 0, value, 2)
        frames += bench.wait(1)
    frames += bench.wait(20)
    values = [int.from_bytes(f.data, "little") for f in frames if f.can_id == 0x385]
    assert values == [5, 7]  # 0 at the start; then what is true each time the 5 ms are over


def test_event_timer_repeats_without_a_change(bench) -> None:
    bench.remap(2, ["6041:0/16"], 255, inhibit_100us=0, event_ms=25)
    bench.nmt(START)
    assert len([f for f in bench.wait(100) if f.can_id == 0x285]) == 4


def test_event_driven_tpdo_is_sent_when_the_node_starts(bench) -> None:
    assert bench.nmt(START) == [Frame(0x285, struct.pack("<HbH", 0x0240, 0, 0))]


def test_event_driven_rpdo_takes_effect_at_once(bench) -> None:
    bench.remap(2, ["6071:0/16"], 255, base=pdo.RECEIVE)
    bench.nmt(START)
    bench.send(0x305, b"\x10\0")
    assert bench.read_int(0x6071) == 16


def test_synchronous_rpdo_waits_for_sync_and_the_last_one_counts(bench) -> None:
    bench.nmt(START)
    bench.target(torque=1)
    bench.target(torque=2)
    assert bench.read_int(0x6071) == 0
    bench.sync()
    assert bench.read_int(0x6071) == 2


def test_remapping_while_operational(bench) -> None:
    bench.nmt(START)
    bench.sync()
    bench.remap(1, ["606C:0/32", "6077:0/16"], 1)
    bench.measurement = (0, -9, 1.0)
    assert bench.sync() == [Frame(0x185, struct.pack("<ih", -9, 500))]


def test_moved_identifiers(bench) -> None:
    bench.nmt(START)
    bench.write(0x1401, 1, 0x8000_0305, 4)
    bench.write(0x1401, 1, 0x444, 4)
    bench.target(torque=5)
    bench.send(0x444, struct.pack("<hi", 6, 0))
    bench.sync()
    assert bench.read_int(0x6071) == 6
    bench.write(0x1800, 1, 0x8000_0185, 4)
    assert bench.sync() == []
    bench.write(0x1800, 1, 0x222, 4)
    assert [f.can_id for f in bench.sync()] == [0x222]


def test_refused_identifiers(bench) -> None:
    assert bench.refused(0x1800, 1, 0x4000_0186, 4) is Abort.STATE  # only while the PDO is off
    assert bench.refused(0x1802, 1, 0x2000_0385, 4) is Abort.VALUE  # 29-bit
    for restricted in (0x000, 0x07F, 0x101, 0x180, 0x585, 0x605, 0x6E0, 0x705, 0x7FF):
        assert bench.refused(0x1802, 1, restricted, 4) is Abort.VALUE
    assert bench.refused(0x1800, 3, 5, 2) is Abort.STATE  # inhibit time while in use


def test_rpdo_cannot_write_what_an_sdo_cannot(bench) -> None:
    bench.nmt(START)
    bench.control(0, 2)  # mode velocity of CiA 402 is not supported
    assert bench.read_int(0x6060) == 0
    bench.control(0, 10)
    assert bench.read_int(0x6060) == 10


def test_short_rpdo_is_reported_once_and_cleared_by_a_good_one(bench, emergencies) -> None:
    bench.nmt(START)
    assert emergencies(bench.send(0x305, b"\1\0")) == [(0x8210, 0x11)]
    assert emergencies(bench.send(0x305, b"")) == []
    bench.sync()
    assert bench.read_int(0x6071) == 0
    assert emergencies(bench.target(torque=3)) == [(0, 0)]


def test_long_rpdo_uses_its_first_bytes(bench, emergencies) -> None:
    bench.nmt(START)
    assert emergencies(bench.send(0x305, struct.pack("<hih", 7, 8, 9))) == []
    bench.sync()
    assert bench.read_int(0x6071) == 7
