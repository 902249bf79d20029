"""The CiA 301 side of an emulated drive, frame by frame.

The first part is the probe table by which the `canopen` package's LocalNode was found wanting, row by row.
"""

import struct

import pytest

from emulator.device import Device
from protocols import nmt, sdo, sdoblock
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
    bench.remap(1, ["6041:0/16"], 3)
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
