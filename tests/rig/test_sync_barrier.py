"""SYNC is the rig's clock: one instant for all drives, however the buses are scheduled."""

from collections.abc import Sequence

import pytest

from emulator.machine import load_machine
from emulator.rig import PATIENCE_PERIODS, SILENT_PERIODS, EmulatedRig
from protocols import nmt
from protocols.frames import Frame
from protocols.rig import load_rig

PERIOD = 1_000_000


@pytest.fixture
def rig() -> EmulatedRig:
    """A TX40 rig with its drives OPERATIONAL; two buses of three drives."""
    files, robot = load_rig("tx40-rig")
    emulated = EmulatedRig(files, load_machine(files, robot))
    emulated.start(0)
    emulated.step(0, [[nmt.command(nmt.Command.START)]] * 2)
    return emulated


def feedback(sent: Sequence[Sequence[Frame]]) -> list[int]:
    """Nodes that answered a SYNC, bus by bus."""
    return [f.can_id - 0x180 for bus in sent for f in bus if 0x180 < f.can_id < 0x200]


def test_both_buses_latch_the_same_instant(rig: EmulatedRig) -> None:
    assert feedback(rig.step(PERIOD, [[nmt.sync(1)], [nmt.sync(1)]])) == [1, 2, 3, 4, 5, 6]
    assert rig.cycles == 1


def test_the_second_bus_may_come_later(rig: EmulatedRig) -> None:
    assert feedback(rig.step(PERIOD, [[nmt.sync(1)], []])) == [1, 2, 3]
    assert feedback(rig.step(PERIOD + 300_000, [[], [nmt.sync(1)]])) == [4, 5, 6]
    assert rig.cycles == 1, "the SYNC with the same counter is the same instant"


def test_a_backlog_on_one_bus_waits_for_the_other(rig: EmulatedRig) -> None:
    rig.step(PERIOD, [[nmt.sync(1)], [nmt.sync(1)]])
    assert feedback(rig.step(PERIOD, [[nmt.sync(2), nmt.sync(3)], []])) == [1, 2, 3]
    assert sorted(feedback(rig.step(PERIOD, [[], [nmt.sync(2), nmt.sync(3)]]))) == [1, 2, 3, 4, 4, 5, 5, 6, 6]
    assert rig.cycles == 3
    assert rig.skewed == 0


def test_a_bus_that_has_fallen_silent_is_left_behind_and_counted(rig: EmulatedRig) -> None:
    rig.step(PERIOD, [[nmt.sync(1)], [nmt.sync(1)]])
    rig.step(2 * PERIOD, [[nmt.sync(2)], []])
    assert feedback(rig.step(2 * PERIOD, [[nmt.sync(3)], []])) == [], "the second bus still owes SYNC 2"
    late = (2 + PATIENCE_PERIODS) * PERIOD
    assert feedback(rig.step(late, [[], []])) == [1, 2, 3]
    assert rig.skewed == 1


def test_one_bus_alone_needs_no_other(rig: EmulatedRig) -> None:
    for n in range(1, 6):
        assert feedback(rig.step(n * PERIOD, [[nmt.sync(n)], []])) == [1, 2, 3]
    assert rig.skewed == 0


def test_without_sync_the_arm_follows_the_clock(rig: EmulatedRig) -> None:
    rig.step(PERIOD, [[nmt.sync(1)], [nmt.sync(1)]])
    warm = rig.plant.motor_temperature_C.copy()
    rig.plant.motor_temperature_C += 10.0
    rig.step(PERIOD + SILENT_PERIODS * PERIOD // 2, [[], []])
    assert (rig.plant.motor_temperature_C == warm + 10).all(), "a host that is a little late stretches time"
    rig.step(PERIOD + 2 * SILENT_PERIODS * PERIOD, [[], []])
    assert (rig.plant.motor_temperature_C < warm + 10).all(), "a host at rest must not freeze the machine"
