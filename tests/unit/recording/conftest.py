"""What the two buses of the TX40 rig carry, with faults put in by hand, and recordings of it."""

import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from daq.recorder import Recorder, Summary
from protocols import nmt
from protocols.frames import Frame
from protocols.rig import Rig, load_rig
from protocols.robot import Robot

MS = 1_000_000
Batch = tuple[str, list[tuple[int, Frame]]]


class Wire:
    """Traffic of a rig: each cycle RPDO2s, SYNC with its counter, TPDO1s; position = SYNC index, current = node."""

    def __init__(self) -> None:
        self.rig, self.robot = load_rig("tx40-rig")
        self.t_ns = 0
        self.index = 0
        self.counter = 0
        self.consumed = dict.fromkeys([d.joint for d in self.rig.drive], 0)  # 0x2001 of each drive

    def cycles(self, count: int) -> list[Batch]:
        """The next cycles, a batch per bus and cycle."""
        return [batch for _ in range(count) for batch in self.cycle()]

    def cycle(self) -> list[Batch]:
        self.t_ns += MS
        self.index += 1
        self.counter = nmt.next_counter(self.counter, self.rig.sync_overflow)
        batches = []
        for bus in self.rig.bus:
            drives = [d for d in self.rig.drive if d.bus == bus.name]
            frames = [Frame(nmt.rpdo_id(2, d.node), bytes(6)) for d in drives] + [nmt.sync(self.counter)]
            for d in drives:
                self.consumed[d.joint] = (self.consumed[d.joint] + 1) % 65536
                data = struct.pack("<ihH", self.index, d.node, self.consumed[d.joint])
                frames.append(Frame(nmt.tpdo_id(1, d.node), data))
            batches.append((bus.name, [(self.t_ns, f) for f in frames]))
        return batches


def drop(batches: list[Batch], which: Callable[[str, int, Frame], bool]) -> list[Batch]:
    """Traffic without the frames that `which(bus, t_ns, frame)` picks."""
    return [(bus, [(t, f) for t, f in frames if not which(bus, t, f)]) for bus, frames in batches]


@pytest.fixture
def wire() -> Wire:
    return Wire()


@pytest.fixture(name="drop")
def drop_fixture() -> Callable[..., list[Batch]]:
    return drop


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., Summary]:
    """Record traffic of the TX40 rig."""

    def make(
        batches: list[Batch], name: str = "run.mcap", rig: Rig | None = None, robot: Robot | None = None
    ) -> Summary:
        tx40_rig, tx40 = load_rig("tx40-rig")
        recorder = Recorder(tmp_path / name, rig or tx40_rig, robot or tx40, {"joint1.eds": "[FileInfo]\n"}, seed=1)
        for bus, frames in batches:
            recorder.frames(bus, frames)
        return recorder.close()

    return make
