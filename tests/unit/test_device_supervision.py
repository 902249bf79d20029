"""Who watches whom and what is in step: SYNC, TIME, EMCY, heartbeats and guarding of an emulated device."""

import struct

import pytest

from protocols import nmt, sdo
from protocols.frames import REMOTE, Frame
from protocols.sdo import Abort

START, STOP = nmt.Command.START, nmt.Command.STOP


# --- SYNC ---


def test_all_rows_of_sync_counter_overflow(bench) -> None:
    assert bench.refused(0x1019, 0, 1, 1) is Abort.VALUE
    bench.write(0x1019, 0, 240, 1)
    bench.write(0x1006, 0, 1000, 4)
    assert bench.refused(0x1019, 0, 2, 1) is Abort.STATE  # CiA 301: only while the period is 0


def test_sync_without_the_counter_that_was_agreed_on(bench, emergencies) -> None:
    bench.write(0x1019, 0, 240, 1)
    bench.nmt(START)
    sent = bench.drive.on_sync(0, None, (0, 0, 0.0))
    assert emergencies(sent) == [(0x8240, 0x11)]
    assert 0x185 in {f.can_id for f in sent}
    assert emergencies(bench.sync()) == [(0, 0)]


def test_sync_on_another_identifier(bench) -> None:
    assert bench.refused(0x1005, 0, 0x605, 4) is Abort.VALUE
    assert bench.refused(0x1005, 0, 0x2000_0081, 4) is Abort.VALUE  # 29-bit
    bench.write(0x1005, 0, 0x81, 4)
    bench.nmt(START)
    bench.target(torque=5)
    assert bench.sync(3) == []
    assert bench.read_int(0x6071) == 0
    assert [f.can_id for f in bench.send(0x81)] == [0x185]
    assert bench.read_int(0x6071) == 5 and bench.read_int(0x2001) == 1


def test_sync_producer(bench) -> None:
    bench.write(0x1019, 0, 3, 1)
    bench.write(0x1005, 0, 0x4000_0080, 4)
    assert bench.refused(0x1005, 0, 0x4000_0081, 4) is Abort.STATE  # not while it produces
    assert bench.wait(20) == []  # no period yet
    bench.write(0x1006, 0, 5000, 4)
    assert [f.data[0] for f in bench.wait(26)] == [1, 2, 3, 1, 2]
    bench.nmt(STOP)
    assert bench.wait(20) == []
    bench.nmt(START)
    assert [f.data[0] for f in bench.wait(15) if f.can_id == 0x80] == [1, 2, 3]
    bench.write(0x1005, 0, 0x80, 4)
    assert [f for f in bench.wait(20) if f.can_id == 0x80] == []


def test_jump_of_the_sync_counter(bench, emergencies) -> None:
    bench.write(0x1019, 0, 240, 1)
    bench.nmt(START)
    assert emergencies(bench.sync(300)) == []  # across the overflow
    bench.counter += 3
    assert emergencies(bench.sync()) == [(0x8701, 0x21)]
    assert emergencies(bench.sync()) == [(0, 0)]
    bench.counter -= 1  # the same one twice
    assert emergencies(bench.sync(2)) == [(0x8701, 0x21), (0, 0)]
    bench.nmt(STOP)
    bench.counter = 0
    bench.nmt(START)
    assert emergencies(bench.sync(2)) == []  # it may begin anew after STOPPED


# --- TIME ---


def test_time_of_day(bench) -> None:
    assert [bench.read_int(0x2004, i) for i in (1, 2)] == [0, 0]
    bench.send(nmt.TIME, struct.pack("<IH", 0xF000_0000 | 86_399_000, 14_000))
    bench.wait(2500)
    assert [bench.read_int(0x2004, i) for i in (1, 2)] == [1500, 14_001]
    bench.send(nmt.TIME, b"short")
    assert bench.read_int(0x2004, 2) == 14_001
    bench.write(0x1012, 0, 0x100, 4)  # not consumed any more
    bench.send(nmt.TIME, bytes(6))
    assert bench.read_int(0x2004, 2) == 14_001
    assert bench.refused(0x1012, 0, 0x4000_0100, 4) is Abort.VALUE  # no producer


# --- EMCY ---


def test_emergency_updates_register_and_history(bench, emergencies) -> None:
    with pytest.raises(sdo.SdoError, match="no data available"):
        bench.read(0x1003, 1)
    assert emergencies(bench.drive.fault(0, 0x4310)) == [(0x4310, 0x09)]
    assert emergencies(bench.drive.fault(0, 0x3210)) == [(0x3210, 0x0D)]
    assert bench.read_int(0x1001) == 0x0D
    assert [bench.read_int(0x1003, i) for i in range(3)] == [2, 0x3210, 0x4310]
    assert bench.refused(0x1003, 0, 1, 1) is Abort.VALUE
    bench.write(0x1003, 0, 0, 1)
    assert bench.read_int(0x1003) == 0


def test_emergency_history_keeps_the_latest_eight(bench) -> None:
    for i in range(10):
        bench.drive.fault(0, 0x2300 + i)
    assert [bench.read_int(0x1003, i) for i in range(9)] == [8, *(0x2300 + i for i in range(9, 1, -1))]


def test_emergency_inhibit_time(bench, emergencies) -> None:
    bench.write(0x1015, 0, 100, 2)  # 10 ms
    first = bench.keep(bench.drive.fault(0, 0x2310))
    second = bench.keep(bench.drive.fault(0, 0x4310))
    assert emergencies(first) == [(0x2310, 3)] and emergencies(second) == []
    assert emergencies(bench.wait(9)) == []
    assert emergencies(bench.wait(1)) == [(0x4310, 0x0B)]


def test_emergency_identifier(bench, emergencies) -> None:
    assert bench.refused(0x1014, 0, 0xC5, 4) is Abort.STATE
    bench.write(0x1014, 0, 0x8000_0085, 4)
    assert emergencies(bench.drive.fault(0, 0x2310)) == []
    bench.write(0x1014, 0, 0x8000_00C5, 4)
    bench.write(0x1014, 0, 0xC5, 4)
    assert bench.refused(0x1014, 0, 0x8000_0605, 4) is Abort.VALUE
    assert [f.can_id for f in bench.drive.fault(0, 0x4310)] == [0xC5]


def test_no_emergency_when_stopped(bench, emergencies) -> None:
    bench.nmt(STOP)
    assert emergencies(bench.drive.fault(0, 0x2310)) == []
    bench.nmt(nmt.Command.ENTER_PRE_OPERATIONAL)
    assert bench.read_int(0x1003, 1) == 0x2310


# --- heartbeat consumer ---


def watch(bench, node: int = 127, milliseconds: int = 50) -> None:
    bench.write(0x1016, 1, node << 16 | milliseconds, 4)


def test_lost_heartbeat(bench, emergencies) -> None:
    watch(bench)
    bench.nmt(START)
    assert emergencies(bench.wait(200)) == []  # watched from the first one on
    for _ in range(3):
        bench.send(0x77F, b"\5")
        assert emergencies(bench.wait(40)) == []
    assert emergencies(bench.wait(20)) == [(0x8130, 0x11)]
    assert bench.drive.device.state is nmt.State.PRE_OPERATIONAL  # 0x1029:1 = 0
    assert emergencies(bench.send(0x77F, b"\5")) == [(0, 0)]


@pytest.mark.parametrize(("behaviour", "state"), [(0, 127), (1, 5), (2, 4)])
def test_error_behaviour(bench, behaviour: int, state: int) -> None:
    bench.write(0x1029, 1, behaviour, 1)
    watch(bench)
    bench.nmt(START)
    bench.send(0x77F, b"\5")
    bench.wait(100)
    assert bench.drive.device.state == state


def test_watching_ends_with_its_object(bench, emergencies) -> None:
    watch(bench)
    bench.send(0x77F, b"\5")
    bench.write(0x1016, 1, 0, 4)
    assert emergencies(bench.wait(100)) == []
    watch(bench)
    bench.send(0x77F, b"\5")
    bench.wait(100)
    bench.write(0x1016, 1, 0, 4)
    assert emergencies(bench.log) == [(0x8130, 0x11), (0, 0)]


def test_garbage_is_no_heartbeat(bench, emergencies) -> None:
    watch(bench)
    bench.send(0x77F, b"\5")
    for data in (b"", b"\5\5", b"\x22"):
        bench.wait(20)
        bench.send(0x77F, data)
    assert emergencies(bench.log) == [(0x8130, 0x11)]


def test_one_node_cannot_be_watched_twice(bench) -> None:
    watch(bench)
    assert bench.refused(0x1016, 2, 127 << 16 | 10, 4) is Abort.INCOMPATIBLE
    assert bench.refused(0x1016, 2, 200 << 16 | 10, 4) is Abort.VALUE
    bench.write(0x1016, 2, 126 << 16 | 10, 4)


# --- node guarding ---


def guard(bench) -> list[Frame]:
    return bench.send(0x705 | REMOTE)


def test_node_guarding_toggles(bench) -> None:
    assert [guard(bench) for _ in range(3)] == [[Frame(0x705, bytes((s,)))] for s in (0x7F, 0xFF, 0x7F)]
    bench.nmt(STOP)
    assert guard(bench) == [Frame(0x705, b"\x84")]
    bench.nmt(nmt.Command.RESET_COMMUNICATION)
    assert guard(bench) == [Frame(0x705, b"\x7f")]


def test_heartbeat_excludes_guarding(bench) -> None:
    bench.write(0x1017, 0, 100, 2)
    assert guard(bench) == []


def test_life_guarding(bench, emergencies) -> None:
    bench.write(0x100C, 0, 20, 2)
    bench.write(0x100D, 0, 3, 1)
    bench.nmt(START)
    assert emergencies(bench.wait(200)) == []  # from the first question on
    guard(bench)
    assert emergencies(bench.wait(59)) == []
    guard(bench)
    assert emergencies(bench.wait(60)) == [(0x8130, 0x11)]
    assert bench.drive.device.state is nmt.State.PRE_OPERATIONAL
    assert emergencies(guard(bench)) == [(0, 0)]
    bench.write(0x100D, 0, 0, 1)
    assert emergencies(bench.wait(200)) == []
