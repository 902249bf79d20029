"""Drives on one bus hear each other, and live on without a host."""

import pytest

from emulator.machine import load_machine
from emulator.rig import EmulatedRig
from protocols import nmt, sdo
from protocols.frames import Frame
from protocols.rig import load_rig

MS = 1_000_000


class Together:
    """A TX40 rig without a host; nodes 1 to 3 on the first bus."""

    def __init__(self) -> None:
        files, robot = load_rig("tx40-rig")
        self.rig = EmulatedRig(files, load_machine(files, robot))
        self.rig.start(0)
        self.t_ns = 0

    def say(self, *frames: Frame) -> list[Frame]:
        """One step with frames on the first bus; returns what its drives say."""
        self.t_ns += MS
        return self.rig.step(self.t_ns, [list(frames), []])[0]

    def wait(self, milliseconds: int) -> list[Frame]:
        return [f for _ in range(milliseconds) for f in self.say()]

    def write(self, node: int, index: int, sub: int, value: int, size: int) -> None:
        transfer = sdo.Download(index, sub, value.to_bytes(size, "little"))
        answers = self.say(Frame(nmt.sdo_request_id(node), transfer.request()))
        transfer.receive(next(f.data for f in answers if f.can_id == nmt.sdo_response_id(node)))
        assert transfer.done


@pytest.fixture
def together() -> Together:
    return Together()


def test_one_drive_watches_another(together: Together) -> None:
    together.write(1, 0x1017, 0, 20, 2)
    together.write(2, 0x1016, 1, 1 << 16 | 50, 4)
    assert not [f for f in together.wait(200) if f.can_id == nmt.emcy_id(2)]
    together.write(1, 0x1017, 0, 0, 2)
    emergencies = [f for f in together.wait(100) if f.can_id == nmt.emcy_id(2)]
    assert [f.data[:2] for f in emergencies] == [b"\x30\x81"]


def test_a_drive_that_produces_sync_is_the_clock_of_all(together: Together) -> None:
    together.say(nmt.command(nmt.Command.START))
    together.write(3, 0x1006, 0, 5000, 4)
    together.write(3, 0x1005, 0, 0x4000_0080, 4)
    cycles = together.rig.cycles
    said = together.wait(52)
    assert sum(f.can_id == nmt.SYNC for f in said) == 10
    assert together.rig.cycles - cycles == 10
    for node in (1, 2, 3):
        assert sum(f.can_id == nmt.tpdo_id(1, node) for f in said) == 10


def test_the_position_is_fresh_without_sync(together: Together) -> None:
    together.rig.plant.q[0] = 0.1
    together.wait(30)
    counts = together.rig.plant.measure()[0][0]
    drive = together.rig.drives[0]
    assert int.from_bytes(drive.device.store.read(0x6064, 0), "little", signed=True) == counts != 0


def test_a_profile_move_needs_no_sync(together: Together) -> None:
    """Set up and commanded by SDO alone, as commissioning tools do."""
    drive = together.rig.drives[0]
    together.wait(30)
    begin = drive.device.store.values[0x6064_00]
    together.write(1, 0x6060, 0, 1, 1)
    for word in (0x06, 0x07, 0x0F):
        together.write(1, 0x6040, 0, word, 2)
    together.wait(30)
    together.write(1, 0x607A, 0, (begin + 100_000) & 0xFFFF_FFFF, 4)
    together.write(1, 0x6040, 0, 0x1F, 2)
    together.wait(700)
    assert drive.device.store.values[0x6064_00] == pytest.approx(begin + 100_000, abs=1300)  # 0x6067
    assert drive.device.store.values[0x6041_00] & 0x1400 == 0x1400  # acknowledged, target reached
