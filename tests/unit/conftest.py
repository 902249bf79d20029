"""A bench for one emulated drive: frames in and out by hand, time by hand."""

import struct

import pytest

from emulator.axis import Measurement
from emulator.drive import Drive
from protocols import cia402, nmt, pdo, sdo, sdoblock
from protocols.frames import Frame
from protocols.robot import Drive as Config

MS = 1_000_000


class Bench:
    """One drive with node-id 5 and what a master on its bus would do with it.

    Attributes:
        log: Every frame the drive has sent.
    """

    node = 5
    config = Config(gear_ratio=-32.0, drive_gain_Nm_A=10.0, rated_current_A=2.0, max_current_A=8.0)

    def __init__(self, **options: object) -> None:
        self.t_ns = 0
        self.counter = 0
        self.drive = Drive(self.config, self.node, **options)
        self.measurement = Measurement(0, 0, 0.0)
        self.log: list[Frame] = []
        self.keep(self.drive.start(0))

    def keep(self, frames: list[Frame]) -> list[Frame]:
        self.log += frames
        return frames

    def send(self, can_id: int, data: bytes = b"") -> list[Frame]:
        return self.keep(self.drive.receive(self.t_ns, Frame(can_id, data)))

    def nmt(self, command: nmt.Command, node: int = 0) -> list[Frame]:
        return self.keep(self.drive.receive(self.t_ns, nmt.command(command, node)))

    def wait(self, milliseconds: float, step_ms: float = 1.0) -> list[Frame]:
        """Let time pass without SYNC; the axis moves on with every step, as in the rig."""
        frames = []
        for _ in range(round(milliseconds / step_ms)):
            self.t_ns += round(step_ms * MS)
            frames += self.drive.tick(self.t_ns)
            frames += self.drive.proceed(self.t_ns, self.measurement)
        return self.keep(frames)

    def sync(self, count: int = 1) -> list[Frame]:
        """SYNCs at 1 kHz with their counter."""
        frames = []
        for _ in range(count):
            self.t_ns += MS
            self.counter = nmt.next_counter(self.counter, 240)
            frames += self.drive.on_sync(self.t_ns, self.counter, self.measurement)
        return self.keep(frames)

    def write(self, index: int, sub: int, value: int, size: int) -> None:
        self.write_bytes(index, sub, (value & (1 << 8 * size) - 1).to_bytes(size, "little"))

    def write_bytes(self, index: int, sub: int, data: bytes) -> None:
        self.run(sdo.Download(index, sub, data))

    def read(self, index: int, sub: int = 0) -> bytes:
        transfer = sdo.Upload(index, sub)
        self.run(transfer)
        return transfer.data

    def read_int(self, index: int, sub: int = 0, *, signed: bool = False) -> int:
        return int.from_bytes(self.read(index, sub), "little", signed=signed)

    def run(self, transfer: sdo.Upload | sdo.Download) -> None:
        """Bring an SDO transfer to its end."""
        request: bytes | None = transfer.request()
        while request is not None:
            answers = [f for f in self.send(nmt.sdo_request_id(self.node), request) if f.can_id == 0x580 + self.node]
            assert len(answers) == 1, answers
            request = transfer.receive(answers[0].data)
        assert transfer.done

    def run_block(self, transfer: sdoblock.BlockUpload | sdoblock.BlockDownload) -> None:
        """Bring an SDO block transfer to its end."""
        requests = [transfer.request()]
        while requests:
            answers = [f for r in requests for f in self.send(nmt.sdo_request_id(self.node), r)]
            requests = [r for f in answers if f.can_id == 0x580 + self.node for r in transfer.receive(f.data)]
        assert transfer.done

    def remap(self, number: int, layout: list[str], kind: int, base: int = pdo.TRANSMIT, **options: int) -> None:
        """Give a PDO a new content by the standard procedure."""
        name = nmt.tpdo_id if base == pdo.TRANSMIT else nmt.rpdo_id
        mapped = [pdo.Mapped.parse(t) for t in layout]
        for write in pdo.configuration(base, number, name(number, self.node), mapped, kind, **options):
            self.write_bytes(*write)

    def refused(self, index: int, sub: int, value: int, size: int) -> sdo.Abort:
        """Abort code that a download ends with."""
        with pytest.raises(sdo.SdoError) as error:
            self.write(index, sub, value, size)
        return sdo.Abort(error.value.code)

    def control(self, word: int, mode: int) -> list[Frame]:
        """RPDO1 as it is after power on."""
        return self.send(nmt.rpdo_id(1, self.node), struct.pack("<Hb", word, mode))

    def target(self, torque: int = 0, position: int = 0) -> list[Frame]:
        """RPDO2 as it is after power on."""
        return self.send(nmt.rpdo_id(2, self.node), struct.pack("<hi", torque, position))

    @property
    def statusword(self) -> int:
        return self.read_int(0x6041)

    def enable(self, mode: cia402.Mode = cia402.Mode.CST) -> None:
        """NMT start and the way to OPERATION_ENABLED, with 0x6061 showing the mode."""
        self.nmt(nmt.Command.START)
        for word in (0x06, 0x07, 0x0F):
            self.control(word, mode)
        self.wait(5)
        assert self.drive.state is cia402.State.OPERATION_ENABLED


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture
def make_bench() -> type[Bench]:
    """Benches with options of the drive."""
    return Bench


def emergencies(frames: list[Frame]) -> list[tuple[int, int]]:
    """Code and register of the EMCY messages of node 5 among `frames`."""
    return [struct.unpack_from("<HB", f.data) for f in frames if f.can_id == 0x85]


@pytest.fixture(name="emergencies")
def emergencies_fixture():
    return emergencies
