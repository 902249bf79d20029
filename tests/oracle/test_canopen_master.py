"""The `canopen` package (2.4.1) as master of an emulated drive: its SDO, PDO, NMT and CiA 402 code against ours."""

import io
import queue
import struct
import threading
import time
from collections.abc import Iterator

import can
import canopen
import pytest
from canopen.profiles.p402 import BaseNode402

from emulator.axis import Measurement
from emulator.drive import Drive
from protocols import emcy, nmt
from protocols.eds import eds
from protocols.frames import EXTENDED, REMOTE, Frame
from protocols.objects import Code, Type
from protocols.robot import Drive as Config

NODE = 5
CONFIG = Config(gear_ratio=-32.0, drive_gain_Nm_A=10.0, rated_current_A=2.0, max_current_A=8.0)


class DriveBus(can.BusABC):
    """A CAN bus with one drive on it. Time runs as it does for the master, whose timeouts are real.

    Attributes:
        moving: The axis goes where the drive sends it.
    """

    def __init__(self, drive: Drive) -> None:
        super().__init__(channel="drive")
        self.drive = drive
        self.moving = False
        self._lock = threading.Lock()
        self._frames: queue.SimpleQueue[Frame] = queue.SimpleQueue()
        self._start_ns = time.monotonic_ns()
        self._put(drive.start(0))

    def _put(self, frames: list[Frame]) -> None:
        for frame in frames:
            self._frames.put(frame)

    def now_ns(self) -> int:
        return time.monotonic_ns() - self._start_ns

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        flags = (EXTENDED if msg.is_extended_id else 0) | (REMOTE if msg.is_remote_frame else 0)
        with self._lock:
            self._put(self.drive.receive(self.now_ns(), Frame(msg.arbitration_id | flags, bytes(msg.data))))

    def sync(self, counter: int | None, measurement: Measurement) -> None:
        with self._lock:
            self._put(self.drive.on_sync(self.now_ns(), counter, measurement))

    def fault(self, code: int) -> None:
        with self._lock:
            self._put(self.drive.fault(self.now_ns(), code))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        end_ns = self.now_ns() + round(1e9 * (timeout or 0))
        while True:
            with self._lock:
                self._put(self.drive.tick(self.now_ns()))
                if self.moving:
                    there = Measurement(round(self.drive.command().target_position), 0, 0.0)
                    self._put(self.drive.proceed(self.now_ns(), there))
            try:
                frame = self._frames.get(timeout=1e-3)
            except queue.Empty:
                if self.now_ns() >= end_ns:
                    return None, False
                continue
            return can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False), False


def data_sheet() -> io.StringIO:
    text = io.StringIO(eds(Drive(CONFIG, NODE).device.store.dictionary))
    text.name = "drive.eds"
    return text


@pytest.fixture
def bus() -> DriveBus:
    return DriveBus(Drive(CONFIG, NODE))


@pytest.fixture
def node(bus: DriveBus) -> Iterator[BaseNode402]:
    network = canopen.Network(bus)
    network.NOTIFIER_CYCLE = 0.02  # how long disconnecting takes
    node = BaseNode402(NODE, data_sheet())
    network.add_node(node)
    network.connect()
    node.sdo.RESPONSE_TIMEOUT = 2.0
    yield node
    network.disconnect()


def test_reset_gives_one_boot_up(node: BaseNode402) -> None:
    heartbeats: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    node.network.subscribe(0x700 + NODE, lambda _, data, __: heartbeats.put(bytes(data)))
    node.nmt.send_command(nmt.Command.RESET_NODE)
    assert node.sdo[0x1000].raw == 0x0002_0192  # answered after whatever the reset has sent
    boot_ups = [heartbeats.get_nowait() for _ in range(heartbeats.qsize())]
    assert boot_ups in ([b"\0"], [b"\0", b"\0"])  # the one of power on may be seen as well
    node.nmt.send_command(nmt.Command.RESET_COMMUNICATION)
    assert node.sdo[0x1000].raw == 0x0002_0192
    assert [heartbeats.get_nowait() for _ in range(heartbeats.qsize())] == [b"\0"]
    assert node.nmt.state == "PRE-OPERATIONAL"


def test_every_readable_object_uploads_its_default(node: BaseNode402) -> None:
    store = Drive(CONFIG, NODE).device.store
    for entry in store.dictionary.entries.values():
        if (entry.index == 0x1003 and entry.sub) or entry.type is Type.DOMAIN:
            continue  # no error, no entry; nothing recorded
        item = node.sdo[entry.index]
        value = (item if store.dictionary.objects[entry.index].code is Code.VAR else item[entry.sub]).raw
        expected = store.values[entry.key]
        assert value == (pytest.approx(expected, rel=1e-6) if isinstance(expected, float) else expected), entry


def test_segmented_transfers(node: BaseNode402) -> None:
    assert node.sdo["Manufacturer device name"].raw == "armrig servo drive"
    for name in ("", "a", "abcdefg", "shoulder of the arm on the left", 64 * "x"):
        node.sdo.download(0x2000, 0, name.encode(), force_segment=True)
        assert node.sdo.upload(0x2000, 0) == name.encode()


@pytest.mark.parametrize(
    ("index", "sub", "data", "code"),
    [
        (0x5000, 0, b"\0", 0x06020000),
        (0x1000, 5, b"\0", 0x06090011),
        (0x6041, 0, b"\0\0", 0x06010002),
        (0x1017, 0, b"\0", 0x06070013),
        (0x1017, 0, bytes(4), 0x06070012),
        (0x6007, 0, b"\4\0", 0x06090031),
        (0x6007, 0, b"\xff\xff", 0x06090032),
        (0x1A00, 0, b"\0", 0x08000022),
        (0x1A02, 1, bytes.fromhex("10003412"), 0x06040041),
        (0x1A02, 0, b"\t", 0x06040042),
    ],
)
def test_abort_codes(node: BaseNode402, index: int, sub: int, data: bytes, code: int) -> None:
    with pytest.raises(canopen.SdoAbortedError) as error:
        node.sdo.download(index, sub, data)
    assert error.value.code == code


@pytest.mark.parametrize("size", [5, 7, 13, 63])
def test_block_download(node: BaseNode402, bus: DriveBus, size: int) -> None:
    name = bytes(ord("a") + i % 26 for i in range(size))
    with node.sdo[0x2000].open("wb", block_transfer=True, size=size) as file:
        file.write(name)
    assert bus.drive.device.store.values[0x2000_00] == name.decode()
    assert node.sdo.upload(0x2000, 0) == name


@pytest.mark.parametrize("with_crc", [True, False])
@pytest.mark.parametrize("samples", [1, 111, 1000])  # the largest is nine blocks
def test_block_upload_of_the_recorder(node: BaseNode402, bus: DriveBus, samples: int, with_crc: bool) -> None:
    node.sdo["Recorder"]["Samples"].raw = samples
    node.sdo["Recorder"]["Control"].raw = 1
    bus.drive.record(range(2 * samples), [0.001 * n for n in range(2 * samples)])
    assert node.sdo["Recorder"]["State"].raw == 3
    with node.sdo[0x2041].open("rb", block_transfer=True, request_crc_support=with_crc, buffering=0) as file:
        data = b"".join(iter(lambda: file.read(7), b""))
    assert len(data) == 8 * samples
    assert data == bus.drive.recorder.data()
    assert struct.unpack_from("<ii", data, 8 * (samples - 1)) == (2 * samples - 1, 2 * samples - 2)


def test_block_download_that_is_too_long(node: BaseNode402) -> None:
    with pytest.raises(canopen.SdoAbortedError) as error:
        node.sdo[0x2000].open("wb", block_transfer=True, size=65)
    assert error.value.code == 0x06070012


def test_stored_parameters(node: BaseNode402) -> None:
    node.sdo["Following error window"].raw = 1234
    node.store()
    node.nmt.send_command(nmt.Command.RESET_NODE)
    assert node.sdo["Following error window"].raw == 1234
    node.restore()
    node.nmt.send_command(nmt.Command.RESET_NODE)
    assert node.sdo["Following error window"].raw == 131_072


def test_node_guarding(node: BaseNode402) -> None:
    answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    node.network.subscribe(0x700 + NODE, lambda _, data, __: answers.put(bytes(data)))
    for _ in range(2):
        node.network.send_message(0x700 + NODE, b"", remote=True)
    node.sdo[0x1000].raw  # noqa: B018 -- answered after the two
    seen = [answers.get_nowait() for _ in range(answers.qsize())]
    assert seen[-2:] == [b"\x7f", b"\xff"]


def test_lss(node: BaseNode402, bus: DriveBus) -> None:
    lss = node.network.lss
    lss.RESPONSE_TIMEOUT = 2.0
    assert lss.send_switch_state_selective(0, 0x4152_4D52, 0x0001_0000, NODE) is True
    assert lss.inquire_node_id() == NODE
    assert lss.inquire_lss_address(0x5D) == NODE  # serial number
    lss.configure_node_id(9)
    lss.configure_bit_timing(2)
    lss.store_configuration()
    lss.send_switch_state_global(lss.WAITING_STATE)
    assert node.sdo[0x1000].raw == 0x0002_0192  # the node-id counts from the next reset of communication
    node.nmt.send_command(nmt.Command.RESET_COMMUNICATION)
    moved = canopen.RemoteNode(9, data_sheet())
    node.network.add_node(moved)
    moved.sdo.RESPONSE_TIMEOUT = 2.0
    assert moved.sdo[0x1000].raw == 0x0002_0192
    assert moved.sdo[0x1800][1].raw == 0x4000_0189
    assert bus.drive.device.node_id == 9


def test_lss_fast_scan_finds_a_drive_without_node_id() -> None:
    bus = DriveBus(Drive(CONFIG, 0xFF, serial=0xDEAD_BEEF))
    network = canopen.Network(bus)
    network.NOTIFIER_CYCLE = 0.02
    network.connect()
    try:
        network.lss.RESPONSE_TIMEOUT = 0.02  # most of its questions are answered by silence
        found, identity = network.lss.fast_scan()
        assert found and identity == [0, 0x4152_4D52, 0x0001_0000, 0xDEAD_BEEF]
        network.lss.RESPONSE_TIMEOUT = 2.0
        network.lss.configure_node_id(7)
        network.lss.send_switch_state_global(network.lss.WAITING_STATE)
        node = canopen.RemoteNode(7, data_sheet())
        network.add_node(node)
        node.sdo.RESPONSE_TIMEOUT = 2.0
        assert node.sdo[0x1018][4].raw == 0xDEAD_BEEF
    finally:
        network.disconnect()


def test_pdo_configuration_and_exchange(node: BaseNode402, bus: DriveBus) -> None:
    node.tpdo.read()
    node.rpdo.read()
    assert [v.name for v in node.tpdo[1]] == ["Position actual value", "Current actual value", "SYNC cycle counter"]
    feedback = node.tpdo[3]
    feedback.clear()
    feedback.add_variable("Velocity actual value")
    feedback.add_variable("Error register")
    feedback.cob_id, feedback.trans_type, feedback.enabled = 0x385, 2, True
    node.tpdo.save()
    target = node.rpdo[3]
    target.clear()
    target.add_variable("Target torque")
    target.cob_id, target.trans_type, target.enabled = 0x405, 1, True
    node.rpdo.save()
    node.nmt.state = "OPERATIONAL"
    target["Target torque"].raw = -321
    target.transmit()
    received = threading.Event()
    feedback.add_callback(lambda _: received.set())
    for counter in (1, 2):
        bus.sync(counter, Measurement(-77, 4321, -0.5))
    assert received.wait(2)
    assert feedback["Velocity actual value"].raw == 4321
    assert node.sdo["Target torque"].raw == -321
    assert node.tpdo[1]["Position actual value"].raw == -77
    assert node.tpdo[1]["Current actual value"].raw == -250
    assert node.tpdo[1]["SYNC cycle counter"].raw == 2


def test_nmt_states_by_heartbeat(node: BaseNode402) -> None:
    node.sdo["Producer heartbeat time"].raw = 5
    for state in ("OPERATIONAL", "STOPPED", "PRE-OPERATIONAL"):
        node.nmt.state = state
        deadline = time.monotonic() + 2
        while node.nmt.wait_for_heartbeat(2) != state:
            assert time.monotonic() < deadline


def test_stopped_node_gives_no_sdo_answer(node: BaseNode402) -> None:
    node.nmt.state = "STOPPED"
    node.sdo.RESPONSE_TIMEOUT, node.sdo.MAX_RETRIES = 0.1, 1
    with pytest.raises(canopen.SdoCommunicationError, match="No SDO response"):
        node.sdo.upload(0x1000, 0)


def test_walk_to_operation_enabled(node: BaseNode402, bus: DriveBus) -> None:
    node.nmt.state = "OPERATIONAL"
    node.setup_402_state_machine()
    node.op_mode = "CYCLIC SYNCHRONOUS TORQUE"
    assert node.op_mode == "CYCLIC SYNCHRONOUS TORQUE"
    for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"):
        node.state = state
        assert node.state == state
    node.rpdo[2]["Target torque"].raw = 500
    node.rpdo[2].transmit()
    bus.sync(1, Measurement(0, 0, 0.0))
    assert bus.drive.command().target_current_A == pytest.approx(1.0)
    node.state = "SWITCH ON DISABLED"
    assert bus.drive.command().mode == 0


def test_homing_by_its_own_procedure(node: BaseNode402, bus: DriveBus) -> None:
    node.nmt.state = "OPERATIONAL"
    node.setup_402_state_machine()
    bus.moving = True
    node.sdo["Homing method"].raw = 35
    node.sdo["Home offset"].raw = 123
    assert node.homing(timeout=5)
    assert node.sdo["Position actual value"].raw == 123


def test_profile_position_with_its_own_handshake(node: BaseNode402, bus: DriveBus) -> None:
    node.nmt.state = "OPERATIONAL"
    node.setup_402_state_machine()
    bus.moving = True
    node.sdo["Profile velocity"].raw = 2**24
    node.sdo["Profile acceleration"].raw = node.sdo["Profile deceleration"].raw = 2**28
    node.op_mode = "PROFILED POSITION"
    node.state = "OPERATION ENABLED"
    node.sdo["Target position"].raw = 50_000
    node.sdo["Controlword"].raw = 0x1F
    deadline = time.monotonic() + 5
    while not node.sdo["Statusword"].raw & 0x400:
        assert time.monotonic() < deadline
    assert node.sdo["Position actual value"].raw == 50_000
    assert node.sdo["Statusword"].raw & 0x1000  # the set-point is acknowledged until bit 4 falls
    node.sdo["Controlword"].raw = 0x0F
    assert not node.sdo["Statusword"].raw & 0x1000


def test_fault_and_way_back(node: BaseNode402, bus: DriveBus) -> None:
    node.nmt.state = "OPERATIONAL"
    node.setup_402_state_machine()
    bus.fault(emcy.Code.DRIVE_OVERTEMPERATURE)
    message = node.emcy.wait(0x4310, timeout=2)
    assert message is not None and message.register == 0x09
    assert node.sdo["Error code"].raw == 0x4310
    assert node.sdo["Pre-defined error field"][1].raw == 0x4310
    node.reset_from_fault()
    assert node.state == "OPERATION ENABLED"
    assert [e.code for e in node.emcy.log] == [0x4310, 0]
    assert node.emcy.active == []


def test_gains_are_written_as_reals(node: BaseNode402, bus: DriveBus) -> None:
    bus.drive.changed_gains()
    node.sdo["KR_Current"].raw = 3.5
    assert bus.drive.changed_gains() == pytest.approx((3.5, 0.002))
    assert struct.unpack("<f", node.sdo.upload(0x2010, 0)) == (3.5,)
