"""The recorder inside a drive: triggers, sample period, and what it says of a real simulated arm."""

import struct

import numpy as np
import pytest

from emulator.machine import load_machine
from emulator.rig import EmulatedRig
from emulator.traces import ARMED, COMPLETE, CURRENT, ENABLED, FALLING, IDLE, RECORDING, RISING
from protocols import nmt, sdo, sdoblock
from protocols.frames import Frame
from protocols.rig import load_rig
from protocols.sdo import Abort

SETTINGS = {"period": (3, 2), "samples": (4, 4), "trigger": (5, 1), "level": (6, 4), "before": (7, 4)}


def arm(bench, **settings: int) -> None:
    for name, value in settings.items():
        bench.write(0x2040, SETTINGS[name][0], value, SETTINGS[name][1])
    bench.write(0x2040, 1, 1, 1)


def state(bench) -> int:
    return bench.read_int(0x2040, 2)


def samples(bench) -> list[tuple[int, int]]:
    upload = sdoblock.BlockUpload(0x2041)
    bench.run_block(upload)
    return list(struct.iter_unpack("<ii", upload.data))


def feed(bench, counts: list[int], current_A: float = 0.0) -> None:
    """Readings every 100 us."""
    bench.drive.record(counts, [current_A] * len(counts))


def test_at_once(bench) -> None:
    assert state(bench) == IDLE and samples(bench) == []
    arm(bench, samples=3)
    assert state(bench) == ARMED
    bench.drive.record([1, 2, 3, 4], [0.001, 0.003, 0.005, 0.007])
    assert state(bench) == RECORDING
    bench.drive.record([5, 6, 7, 8], [0.01] * 4)
    assert state(bench) == COMPLETE and not bench.drive.recorder.running
    assert samples(bench) == [(2, 2), (4, 6), (6, 10)]  # position at the instant, mean of the current
    assert bench.read_int(0x2040, 8) == 3


@pytest.mark.parametrize(("trigger", "expected"), [(RISING, [4, 6]), (FALLING, [4, 0])])
def test_position_triggers(bench, trigger: int, expected: list[int]) -> None:
    arm(bench, samples=2, trigger=trigger, level=4)
    feed(bench, [0, 2, 0, 4, 0, 6, 0, 8, 0, 4, 0, 0])
    assert [p for p, _ in samples(bench)] == expected


def test_current_trigger(bench) -> None:
    arm(bench, samples=1, trigger=CURRENT, level=500)
    feed(bench, [1, 1], 0.4)
    assert state(bench) == ARMED
    feed(bench, [2, 2], -0.6)
    assert samples(bench) == [(2, -600)]


def test_trigger_on_enabling(bench) -> None:
    arm(bench, samples=1, trigger=ENABLED)
    feed(bench, [1, 1])
    assert state(bench) == ARMED
    bench.enable()
    bench.sync(7)
    feed(bench, [2, 2])
    assert state(bench) == COMPLETE and bench.read_int(0x2040, 9) == 7


def test_what_was_before_the_trigger(bench) -> None:
    arm(bench, samples=4, trigger=RISING, level=100, before=2)
    feed(bench, [v for k in range(5) for v in (0, 10 * k)])
    feed(bench, [0, 100, 0, 110, 0, 120])
    assert [p for p, _ in samples(bench)] == [30, 40, 100, 110]


def test_slower_sampling_and_stopping(bench) -> None:
    arm(bench, period=500, samples=100)
    feed(bench, list(range(10)))
    bench.write(0x2040, 1, 0, 1)
    assert state(bench) == COMPLETE
    assert [p for p, _ in samples(bench)] == [4, 9]


def test_settings_are_checked(bench) -> None:
    assert bench.refused(0x2040, 3, 199, 2) is Abort.TOO_LOW  # 5 kHz is the most
    assert bench.refused(0x2040, 3, 250, 2) is Abort.VALUE  # not on the grid of 100 us
    assert bench.refused(0x2040, 5, 5, 1) is Abort.TOO_HIGH
    assert bench.refused(0x2040, 4, 100_001, 4) is Abort.TOO_HIGH
    assert bench.refused(0x2040, 7, 5000, 4) is Abort.INCOMPATIBLE
    arm(bench)
    assert bench.refused(0x2040, 4, 5, 4) is Abort.STATE


def test_recording_an_arm_that_moves() -> None:
    """Five samples a period, the fifth of which is what the drive sends; the arm itself is not disturbed."""

    def run(*, recorded: bool) -> tuple[EmulatedRig, list[int]]:
        files, robot = load_rig("emps-rig")
        rig = EmulatedRig(files, load_machine(files, robot))
        node = rig.drives[0].device.node_id
        rig.start(0)
        frames = [nmt.command(nmt.Command.START)]
        frames += [Frame(0x200 + node, struct.pack("<Hb", word, 10)) for word in (6, 7, 15)]
        rig.step(0, [frames])
        seen = []
        for n in range(1, 60):
            burst = [Frame(0x300 + node, struct.pack("<hi", 200, 0)), nmt.sync(n)]
            if n == 20 and recorded:
                request = sdo.Download(0x2040, 1, b"\1").request()
                burst.insert(0, Frame(0x600 + node, request))
            for frame in rig.step(n * 1_000_000, [burst])[0]:
                if frame.can_id == 0x180 + node:
                    seen.append(struct.unpack_from("<i", frame.data)[0])
        return rig, seen

    (rig, seen), (_, undisturbed) = run(recorded=True), run(recorded=False)
    assert seen == undisturbed
    data = np.array(list(struct.iter_unpack("<ii", rig.drives[0].recorder.data())))
    assert len(data) == 5 * 40
    assert np.abs(data[4::5, 0] - seen[19:]).max() <= 8  # encoder noise of one count, drawn apart
    assert np.diff(data[:, 0])[-20:].mean() > 2 * np.diff(data[:, 0])[:20].mean() > 0  # it gathers speed
    assert data[50:, 1].mean() == pytest.approx(1e3 * 0.2 * rig.drives[0].config.rated_current_A, rel=0.05)
