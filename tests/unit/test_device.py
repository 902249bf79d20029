"""The CiA 301 side of an emulated drive, frame by frame.

The first part is the probe table by which the `canopen` package's LocalNode was found wanting, row by row.
"""

import struct

import pytest

from emulator.device import Device
from protocols import nmt, pdo, sdo, sdoblock
from protocols.dictionary import communication_objects
from protocols.frames import ERROR, EXTENDED, REMOTE, Frame
from protocols.objects import Dictionary
from protocols.sdo import Abort

START, STOP = nmt.Command.START, nmt.Command.STOP
BOOT_UP = Frame(0x705, b"\0")


def abort_of(frames: list[Frame]) -> int:
    """Code of the SDO abort that is the only frame."""
    assert len(frames) == 1 and frames[0].can_id == 0x585 and frames[0].data[0] == 0x80, frames
    return int.from_bytes(frames[0].data[4:], "little")


def remap(bench, number: int, layout: list[str], kind: int, base: int = pdo.TRANSMIT, **options: int) -> None:
    name = nmt.tpdo_id if base == pdo.TRANSMIT else nmt.rpdo_id
    mapped = [pdo.Mapped.parse(t) for t in layout]
    for write in pdo.configuration(base, number, name(number, bench.node), mapped, kind, **options):
        bench.write_bytes(*write)


# --- probe table ---


def test_power_on_sends_one_boot_up(bench) -> None:
    assert bench.log == [BOOT_UP]
    assert bench.drive.device.state is nmt.State.PRE_OPERATIONAL


@pytest.mark.parametrize(("index", "sub"), [(0x1000, 5), (0x1018, 9), (0x1A00, 9), (0x6040, 1)])
def test_bad_sub_index(bench, index: int, sub: int) -> None:
    assert abort_of(bench.send(0x605, sdo.Upload(index, sub).request())) == Abort.NO_SUBINDEX


def test_lengths(bench) -> None:
    assert abort_of(bench.send(0x605, sdo.Download(0x1017, 0, b"\1").request())) == Abort.TOO_SHORT
    assert abort_of(bench.send(0x605, sdo.Download(0x1017, 0, b"\1\0\0\0").request())) == Abort.TOO_LONG
    assert abort_of(bench.send(0x605, sdo.Download(0x2000, 0, bytes(65)).request())) == Abort.TOO_LONG


def test_limits(bench) -> None:
    assert bench.refused(0x6007, 0, 4, 2) is Abort.TOO_HIGH
    assert bench.refused(0x6007, 0, -1, 2) is Abort.TOO_LOW
    assert bench.refused(0x1019, 0, 241, 1) is Abort.TOO_HIGH
    with pytest.raises(sdo.SdoError, match="the value is below the object's limit"):
        bench.write_bytes(0x2010, 0, struct.pack("<f", 0.0))
    for value in (float("nan"), float("inf")):
        with pytest.raises(sdo.SdoError, match="the value is not allowed"):
            bench.write_bytes(0x2010, 0, struct.pack("<f", value))


def test_segment_before_any_request(bench) -> None:
    assert abort_of(bench.send(0x605, bytes.fromhex("6000000000000000"))) == Abort.COMMAND
    assert abort_of(bench.send(0x605, bytes.fromhex("0000000000000000"))) == Abort.COMMAND


def test_four_byte_request_is_ignored(bench) -> None:
    assert bench.send(0x605, bytes.fromhex("40001000")) == []
    assert bench.drive.device.ignored == 1


def test_no_sdo_when_stopped(bench) -> None:
    bench.nmt(STOP)
    assert bench.send(0x605, sdo.Upload(0x1000).request()) == []
    bench.nmt(nmt.Command.ENTER_PRE_OPERATIONAL)
    assert bench.read_int(0x1000) == 0x0002_0192


@pytest.mark.parametrize("command", [nmt.Command.RESET_NODE, nmt.Command.RESET_COMMUNICATION])
@pytest.mark.parametrize("state", [START, STOP, nmt.Command.ENTER_PRE_OPERATIONAL])
def test_reset_gives_one_boot_up_and_defaults(bench, command: nmt.Command, state: nmt.Command) -> None:
    remap(bench, 1, ["6041:0/16"], 3)
    bench.write(0x1017, 0, 10, 2)
    bench.write(0x6065, 0, 7, 4)
    bench.nmt(state)
    assert bench.nmt(command) == [BOOT_UP]
    assert bench.drive.device.state is nmt.State.PRE_OPERATIONAL
    assert bench.wait(100) == []  # no heartbeat: 0x1017 is 0 again
    assert bench.read_int(0x1A00) == 3 and bench.read_int(0x1800, 2) == 1
    whole = command is nmt.Command.RESET_NODE
    assert (bench.read_int(0x6065) == 7) is not whole  # a reset of communication keeps 0x2000 to 0x9FFF


def test_sync_sends_tpdo1(bench) -> None:
    bench.nmt(START)
    bench.measurement = (-5, 70, 0.5)
    assert Frame(0x185, struct.pack("<ihH", -5, 250, 1)) in bench.sync()


def test_rpdo_reaches_the_dictionary(bench) -> None:
    bench.nmt(START)
    bench.target(torque=123, position=-4)
    bench.sync()
    assert bench.read_int(0x6071, signed=True) == 123
    assert bench.read_int(0x607A, signed=True) == -4


def test_mapping_refusals(bench) -> None:
    assert bench.refused(0x1A02, 0, 9, 1) is Abort.PDO_LENGTH
    assert bench.refused(0x1A02, 1, 0x1234_0010, 4) is Abort.NOT_MAPPABLE
    assert bench.refused(0x1A02, 1, 0x6064_0008, 4) is Abort.NOT_MAPPABLE
    assert bench.refused(0x1602, 1, 0x6064_0020, 4) is Abort.NOT_MAPPABLE  # read-only
    for sub in (1, 2, 3):
        bench.write(0x1A02, sub, 0x6064_0020, 4)
    assert bench.refused(0x1A02, 0, 3, 1) is Abort.PDO_LENGTH  # twelve bytes
    assert bench.refused(0x1A02, 0, 4, 1) is Abort.NOT_MAPPABLE  # the fourth entry is empty
    bench.write(0x1A02, 0, 2, 1)
    assert bench.refused(0x1A02, 1, 0x6064_0020, 4) is Abort.STATE  # entries only while their number is 0
    assert bench.refused(0x1A00, 0, 0, 1) is Abort.STATE  # mapping only while the PDO is off


def test_block_transfers(bench) -> None:
    name = b"shoulder of the arm that stands on the left"
    bench.run_block(sdoblock.BlockDownload(0x2000, 0, name))
    upload = sdoblock.BlockUpload(0x2000, 0)
    bench.run_block(upload)
    assert upload.data == bench.read(0x2000) == name


# --- network management ---


def test_pdos_only_when_operational(bench) -> None:
    assert bench.sync() == []
    bench.nmt(START)
    assert [f.can_id for f in bench.sync()] == [0x185]
    for leave in (STOP, nmt.Command.ENTER_PRE_OPERATIONAL):
        bench.nmt(START)
        bench.target(torque=1)
        bench.nmt(leave)
        assert bench.target(torque=2) == []
        assert bench.sync(3) == []
    bench.nmt(START)
    assert bench.read_int(0x6071) == 0  # neither the one that waited for its SYNC nor the one that came too early


def test_commands_to_other_nodes_and_garbage(bench) -> None:
    bench.nmt(START, node=6)
    for data in (b"", b"\1", b"\1\5\0", b"\3\5", b"\xff\0"):
        assert bench.send(nmt.NMT, data) == []
    assert bench.drive.device.state is nmt.State.PRE_OPERATIONAL
    assert bench.drive.device.ignored == 5
    bench.nmt(START, node=5)
    assert bench.drive.device.state is nmt.State.OPERATIONAL


@pytest.mark.parametrize(
    ("command", "state"),
    [(START, 5), (STOP, 4), (nmt.Command.ENTER_PRE_OPERATIONAL, 127)],
)
def test_heartbeat_shows_the_state(bench, command: nmt.Command, state: int) -> None:
    bench.write(0x1017, 0, 20, 2)
    bench.nmt(command)
    beats = [f for f in bench.wait(100) if f.can_id == 0x705]
    assert beats == [Frame(0x705, bytes((state,)))] * 5


def test_heartbeat_keeps_its_grid_and_never_bursts(bench) -> None:
    bench.write(0x1017, 0, 10, 2)
    times = []
    for step_ms in (7, 7, 7, 7, 7, 500, 10, 10):
        bench.wait(step_ms, step_ms)
        times += [bench.t_ns // 1_000_000 for f in bench.log[-1:] if f.can_id == 0x705]
        bench.log.clear()
    assert times == [14, 21, 35, 535, 545, 555]


# --- frames no device may react to ---


@pytest.mark.parametrize("flag", [EXTENDED, REMOTE, ERROR, 0x800])
def test_flagged_frames_are_counted_and_ignored(bench, flag: int) -> None:
    bench.nmt(START)
    state = bench.drive.device.state
    for can_id in (0x000, 0x205, 0x305, 0x605, 0x706):
        assert bench.send(can_id | flag, b"\x81\x05\0\0\0\0\0\0") == []
    assert bench.drive.device.ignored == 5
    assert bench.drive.device.state is state


def test_second_node_with_the_same_id(bench) -> None:
    bench.send(0x705, b"\5")
    bench.send(0x585, bytes(8))
    assert bench.drive.device.ignored == 2


# --- PDOs ---


def test_transmission_types(bench) -> None:
    remap(bench, 1, ["2001:0/16"], 3)
    remap(bench, 3, ["6071:0/16"], 0)
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
    remap(bench, 3, ["2001:0/16"], 252)
    allow_rtr(bench, 3)
    bench.nmt(START)
    assert ask(bench, 0x385) == []  # nothing sampled yet
    assert [f.can_id for f in bench.sync(3)] == [0x185] * 3
    assert ask(bench, 0x385) == [b"\3\0"] == ask(bench, 0x385)


def test_tpdo_sampled_and_sent_on_request(bench) -> None:
    remap(bench, 3, ["6071:0/16"], 253)
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
    remap(bench, 1, ["2001:0/16"], 1)
    remap(bench, 3, ["2001:0/16"], 3)
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
    remap(bench, 3, ["6071:0/16"], 255, inhibit_100us=50)
    bench.nmt(START)
    frames = []
    for value in range(1, 8):
        bench.write(0x6071, 0, value, 2)
        frames += bench.wait(1)
    frames += bench.wait(20)
    values = [int.from_bytes(f.data, "little") for f in frames if f.can_id == 0x385]
    assert values == [5, 7]  # 0 at the start; then what is true each time the 5 ms are over


def test_event_timer_repeats_without_a_change(bench) -> None:
    remap(bench, 2, ["6041:0/16"], 255, inhibit_100us=0, event_ms=25)
    bench.nmt(START)
    assert len([f for f in bench.wait(100) if f.can_id == 0x285]) == 4


def test_event_driven_tpdo_is_sent_when_the_node_starts(bench) -> None:
    assert bench.nmt(START) == [Frame(0x285, struct.pack("<HbH", 0x0240, 0, 0))]


def test_event_driven_rpdo_takes_effect_at_once(bench) -> None:
    remap(bench, 2, ["6071:0/16"], 255, base=pdo.RECEIVE)
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
    remap(bench, 1, ["606C:0/32", "6077:0/16"], 1)
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


# --- storing ---


def test_stored_parameters_survive_resets(bench) -> None:
    assert bench.read_int(0x1010, 1) == bench.read_int(0x1011, 1) == 1
    for value in (0, 1, 0x65766174):
        assert bench.refused(0x1010, 1, value, 4) is Abort.NOT_STORED
    bench.write(0x1017, 0, 250, 2)
    bench.write(0x6065, 0, 777, 4)
    bench.write(0x6040, 0, 0x06, 2)
    bench.write_bytes(0x1010, 1, b"save")
    bench.write(0x6065, 0, 778, 4)
    bench.nmt(nmt.Command.RESET_NODE)
    assert (bench.read_int(0x1017), bench.read_int(0x6065)) == (250, 777)
    assert bench.read_int(0x6040) == 0  # commands are not settings
    assert bench.read_int(0x1010, 1) == 1
    bench.keep(bench.drive.start(bench.t_ns))  # power off and on
    assert bench.read_int(0x6065) == 777
    bench.write_bytes(0x1011, 1, b"load")
    assert bench.read_int(0x6065) == 777  # from the next reset on
    bench.nmt(nmt.Command.RESET_NODE)
    assert (bench.read_int(0x1017), bench.read_int(0x6065)) == (0, 131_072)


def test_areas_are_stored_apart(bench) -> None:
    settings = ((0x1017, 2), (0x2003, 2), (0x6065, 4))
    for index, size in settings:
        bench.write(index, 0, 55, size)
    bench.write_bytes(0x1010, 2, b"save")
    bench.write_bytes(0x1010, 4, b"save")
    bench.nmt(nmt.Command.RESET_NODE)
    assert [bench.read_int(index) for index, _ in settings] == [55, 55, 131_072]
    bench.write_bytes(0x1011, 2, b"load")
    bench.nmt(nmt.Command.RESET_COMMUNICATION)
    assert [bench.read_int(index) for index, _ in settings] == [0, 55, 131_072]


# --- SDO on the bus ---


def test_strings_travel_in_segments(bench) -> None:
    assert bench.read(0x1008) == b"armrig servo drive"
    bench.write_bytes(0x2000, 0, b"shoulder, left arm")
    assert bench.read(0x2000) == b"shoulder, left arm"


def test_abandoned_transfer_times_out(bench) -> None:
    bench.send(0x605, sdo.Upload(0x1008).request())
    assert abort_of(bench.wait(1001)) == Abort.TIMEOUT
    assert bench.wait(2000) == []


def test_access(bench) -> None:
    assert bench.refused(0x6041, 0, 0, 2) is Abort.READ_ONLY
    assert bench.refused(0x1000, 0, 0, 4) is Abort.READ_ONLY
    assert bench.refused(0x5555, 0, 0, 4) is Abort.NO_OBJECT


def test_identity(bench) -> None:
    assert [bench.read_int(0x1018, i) for i in range(5)] == [4, 0, 0x4152_4D52, 0x0001_0000, 5]


def test_bus_off(bench, emergencies) -> None:
    bench.nmt(START)
    bench.drive.device.lose_bus(bench.t_ns)
    assert bench.drive.device.state is nmt.State.PRE_OPERATIONAL  # 0x1029
    assert emergencies(bench.drive.device.find_bus(bench.t_ns)) == [(0x8140, 0x11), (0, 0)]


def test_device_without_an_application() -> None:
    device = Device(Dictionary(communication_objects()), 9)
    assert device.start(0) == [Frame(0x709, b"\0")]
    for command in nmt.Command:
        device.receive(0, nmt.command(command, 9))
    assert device.receive(0, Frame(0x609, sdo.Upload(0x1000).request()))[0].can_id == 0x589
    assert device.sync(0, 1) == device.tick(10**9) == []
