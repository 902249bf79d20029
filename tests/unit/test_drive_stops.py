"""How an emulated drive stops and what makes it: option codes, faults, lost masters and SYNC."""

import itertools
import struct

import pytest

from emulator.axis import Command, Measurement
from emulator.drive import Drive
from emulator.stops import BRAKE_DELAY_NS
from protocols import emcy, nmt, sdo
from protocols.cia402 import Mode, State
from protocols.sdo import Abort

MS = 1_000_000
STOPPED = Command(0, 0, 0.0)
MOVING = Measurement(1000, 3_276_800, 0.1)  # 25 motor revolutions per second: 100 ms of the default ramp


# --- stops ---


def moving(bench, option: int) -> Drive:
    """An enabled drive whose motor turns, with a quick stop option."""
    bench.write(0x605A, 0, option, 2)
    bench.enable(Mode.CST)
    bench.measurement = MOVING
    bench.sync()
    return bench.drive


def test_quick_stop_ramp(bench) -> None:
    drive = moving(bench, 2)
    bench.control(0x02, Mode.CST)
    positions = []
    for _ in range(110):
        bench.sync()
        assert drive.state is State.QUICK_STOP_ACTIVE and drive.command().mode == Mode.CSP
        positions.append(drive.command().target_position)
    steps = [b - a for a, b in itertools.pairwise([MOVING.position, *positions])]
    assert steps[0] == pytest.approx(MOVING.velocity * 1e-3, rel=0.01)
    assert all(b <= a for a, b in itertools.pairwise(steps))
    assert steps[-1] == 0
    assert positions[-1] == pytest.approx(MOVING.position + MOVING.velocity**2 / (2 * 250 * 131_072))
    bench.sync(BRAKE_DELAY_NS // MS)
    assert drive.state is State.SWITCH_ON_DISABLED
    assert drive.command().mode == 0


def test_quick_stop_that_holds(bench) -> None:
    drive = moving(bench, 6)
    bench.control(0x02, Mode.CST)
    bench.wait(1000)
    assert drive.state is State.QUICK_STOP_ACTIVE and drive.command().mode == Mode.CSP
    bench.control(0x0F, Mode.CST)  # transition 16
    assert drive.state is State.OPERATION_ENABLED and drive.command().mode == Mode.CST


def test_quick_stop_that_releases_cannot_be_taken_back(bench) -> None:
    drive = moving(bench, 2)
    bench.control(0x02, Mode.CST)
    bench.control(0x0F, Mode.CST)
    assert drive.state is State.QUICK_STOP_ACTIVE


@pytest.mark.parametrize(("option", "milliseconds", "end"), [(1, 250, State.SWITCH_ON_DISABLED), (5, 250, None)])
def test_quick_stop_on_the_slow_ramp(bench, option: int, milliseconds: int, end: State | None) -> None:
    drive = moving(bench, option)
    bench.control(0x02, Mode.CST)
    bench.sync(milliseconds - 1)
    assert drive.axis.reference.velocity > 0
    bench.sync(2 + BRAKE_DELAY_NS // MS)
    assert drive.axis.reference.velocity == 0
    assert drive.state is (end or State.QUICK_STOP_ACTIVE)


@pytest.mark.parametrize(
    ("index", "word", "target"), [(0x605B, 0x06, State.READY_TO_SWITCH_ON), (0x605C, 0x07, State.SWITCHED_ON)]
)
def test_shutdown_and_disabling(bench, index: int, word: int, target: State) -> None:
    bench.write(index, 0, 0, 2)
    drive = moving(bench, 2)
    bench.control(word, Mode.CST)
    assert drive.state is target and drive.command().mode == 0
    bench.control(0x0F, Mode.CST)
    bench.write(index, 0, 1, 2)
    bench.control(word, Mode.CST)
    bench.sync(240)
    assert drive.state is State.OPERATION_ENABLED and drive.command().mode == Mode.CSP
    bench.sync(15 + BRAKE_DELAY_NS // MS)
    assert drive.state is target and drive.command().mode == 0


def test_a_ramp_of_disabling_gives_way_to_stronger_stops(bench) -> None:
    drive = moving(bench, 2)
    bench.control(0x07, Mode.CST)
    bench.control(0x02, Mode.CST)
    assert drive.state is State.QUICK_STOP_ACTIVE
    bench.control(0x00, Mode.CST)
    assert drive.state is State.SWITCH_ON_DISABLED and drive.command().mode == 0


def test_quick_stop_that_coasts(bench) -> None:
    drive = moving(bench, 0)
    bench.control(0x02, Mode.CST)
    assert drive.state is State.SWITCH_ON_DISABLED and drive.command().mode == 0


def test_option_codes_are_checked(bench) -> None:
    for index, value in ((0x605A, 3), (0x605B, 2), (0x605C, -1), (0x605D, 0), (0x605E, 6)):
        assert bench.refused(index, 0, value, 2) is Abort.VALUE
    assert bench.refused(0x6085, 0, 0, 4) is Abort.TOO_LOW


def test_a_ramp_at_rest_takes_the_time_of_the_brake(bench) -> None:
    bench.enable(Mode.CST)
    bench.control(0x02, Mode.CST)
    bench.wait(BRAKE_DELAY_NS // MS)
    assert bench.drive.state is State.SWITCH_ON_DISABLED


# --- faults ---


def test_fault_reaction_ramp_then_fault(bench, emergencies) -> None:
    drive = moving(bench, 2)
    sent = bench.keep(drive.fault(bench.t_ns, emcy.Code.DRIVE_OVERTEMPERATURE))
    assert emergencies(sent) == [(0x4310, 0x09)]
    assert drive.state is State.FAULT_REACTION_ACTIVE and drive.command().mode == Mode.CSP
    assert bench.read_int(0x603F) == 0x4310
    bench.wait(100 + BRAKE_DELAY_NS // MS + 1)
    assert drive.state is State.FAULT and drive.command().mode == 0
    assert bench.statusword == 0x0208


def test_fault_reaction_that_coasts(bench) -> None:
    bench.write(0x605E, 0, 0, 2)
    drive = moving(bench, 2)
    drive.fault(bench.t_ns, emcy.Code.ENCODER)
    assert drive.state is State.FAULT


def test_fault_reset_on_the_rising_edge_only(bench, emergencies) -> None:
    bench.nmt(nmt.Command.START)
    bench.control(0x80, 0)
    bench.drive.fault(bench.t_ns, emcy.Code.OVERCURRENT)
    assert emergencies(bench.control(0x80, 0)) == []  # held high since before the fault
    assert bench.drive.state is State.FAULT
    bench.control(0x00, 0)
    assert bench.drive.state is State.FAULT
    assert emergencies(bench.control(0x80, 0)) == [(0, 0)]
    assert bench.drive.state is State.SWITCH_ON_DISABLED
    assert bench.read_int(0x603F) == 0
    bench.control(0x86, 0)  # bit 7 still masks every command
    assert bench.drive.state is State.SWITCH_ON_DISABLED
    bench.control(0x06, 0)
    assert bench.drive.state is State.READY_TO_SWITCH_ON


def test_several_faults_are_reset_together(bench, emergencies) -> None:
    bench.nmt(nmt.Command.START)
    bench.drive.fault(bench.t_ns, emcy.Code.OVERCURRENT)
    bench.drive.fault(bench.t_ns, emcy.Code.ENCODER)
    assert bench.read_int(0x603F) == emcy.Code.ENCODER
    assert emergencies(bench.control(0x80, 0)) == [(0, 0x21), (0, 0)]


def test_following_error(bench, emergencies) -> None:
    bench.write(0x6065, 0, 500, 4)
    bench.write(0x6066, 0, 10, 2)
    bench.enable(Mode.CSP)
    bench.target(position=501)
    bench.sync(6)
    bench.target(position=500)  # back at the edge of the window in time
    bench.sync(2)
    bench.target(position=-501)
    bench.sync(11)
    assert bench.drive.state is State.OPERATION_ENABLED
    assert bench.read_int(0x60F4, signed=True) == -501
    sent = bench.sync()
    assert emergencies(sent) == [(0x8611, 0x21)]
    assert bench.drive.state is State.FAULT_REACTION_ACTIVE
    bench.wait(100)
    assert bench.statusword == 0x2208
    bench.control(0x80, Mode.CSP)
    assert bench.statusword == 0x0240


def test_following_error_can_be_switched_off(bench, emergencies) -> None:
    bench.write(0x6065, 0, 0xFFFF_FFFF, 4)
    bench.enable(Mode.CSP)
    bench.target(position=2**31 - 1)
    bench.sync(200)
    assert emergencies(bench.log) == []


def test_torque_mode_has_no_following_error(bench, emergencies) -> None:
    bench.enable(Mode.CST)
    bench.target(torque=1, position=10**9)
    bench.sync(200)
    assert emergencies(bench.log) == []


# --- what the bus does to an enabled drive ---


def test_lost_sync_is_a_fault(bench, emergencies) -> None:
    bench.enable(Mode.CST)
    assert emergencies(bench.wait(300)) == []  # no SYNC yet: nothing to miss
    bench.sync(50)
    assert emergencies(bench.wait(99)) == []
    bench.sync(1)
    assert emergencies(bench.wait(99)) == []
    assert emergencies(bench.wait(1)) == [(0x8700, 0x21)]


def test_sync_supervision_can_be_switched_off(bench, emergencies) -> None:
    bench.write(0x2003, 0, 0, 2)
    bench.enable(Mode.CST)
    bench.sync(5)
    assert emergencies(bench.wait(1000)) == []


@pytest.mark.parametrize(
    "command",
    [
        nmt.Command.STOP,
        nmt.Command.ENTER_PRE_OPERATIONAL,
        nmt.Command.RESET_NODE,
        nmt.Command.RESET_COMMUNICATION,
    ],
)
def test_leaving_operational_cuts_the_power(bench, command: nmt.Command) -> None:
    bench.enable(Mode.CST)
    bench.target(torque=300)
    bench.sync()
    bench.nmt(command)
    assert bench.drive.state is State.SWITCH_ON_DISABLED
    assert bench.drive.command().mode == 0


def test_a_ramp_goes_on_when_the_node_leaves_operational(bench) -> None:
    drive = moving(bench, 6)
    bench.control(0x02, Mode.CST)
    bench.nmt(nmt.Command.STOP)
    assert drive.state is State.QUICK_STOP_ACTIVE and drive.command().mode == Mode.CSP
    bench.wait(100 + BRAKE_DELAY_NS // MS + 1)
    assert drive.state is State.SWITCH_ON_DISABLED


def test_a_drive_that_holds_lets_go_when_the_node_leaves_operational(bench) -> None:
    drive = moving(bench, 6)
    bench.control(0x02, Mode.CST)
    bench.wait(1000)
    bench.nmt(nmt.Command.ENTER_PRE_OPERATIONAL)
    assert drive.state is State.SWITCH_ON_DISABLED


@pytest.mark.parametrize(
    ("option", "state"),
    [
        (0, State.OPERATION_ENABLED),
        (1, State.FAULT_REACTION_ACTIVE),
        (2, State.SWITCH_ON_DISABLED),
        (3, State.QUICK_STOP_ACTIVE),
    ],
)
def test_lost_master(bench, emergencies, option: int, state: State) -> None:
    bench.write(0x6007, 0, option, 2)
    bench.write(0x1029, 1, 1, 1)  # stay OPERATIONAL
    bench.write(0x1016, 1, 127 << 16 | 20, 4)
    bench.enable(Mode.CST)
    bench.send(0x77F, b"\5")
    sent = bench.wait(25)
    assert emergencies(sent) == [(0x8130, 0x11)]
    assert bench.drive.state is state


def test_fault_of_a_lost_master_lasts_until_it_is_back(bench) -> None:
    bench.write(0x1016, 1, 127 << 16 | 20, 4)
    bench.enable(Mode.CST)
    bench.send(0x77F, b"\5")
    bench.wait(200)
    assert bench.drive.state is State.FAULT and bench.read_int(0x603F) == 0x8130
    bench.write(0x6040, 0, 0x00, 2)
    bench.write(0x6040, 0, 0x80, 2)
    assert bench.drive.state is State.FAULT
    bench.send(0x77F, b"\5")
    bench.write(0x6040, 0, 0x00, 2)
    bench.write(0x6040, 0, 0x80, 2)
    assert bench.drive.state is State.SWITCH_ON_DISABLED


def test_reset_of_a_faulty_drive(bench) -> None:
    bench.drive.fault(0, emcy.Code.ENCODER)
    bench.nmt(nmt.Command.RESET_COMMUNICATION)
    assert bench.drive.state is State.FAULT and bench.read_int(0x1001) == 0x21
    bench.nmt(nmt.Command.RESET_NODE)
    assert bench.drive.state is State.SWITCH_ON_DISABLED and bench.read_int(0x1001) == 0


def test_controlword_by_sdo(bench) -> None:
    for word in (0x06, 0x07, 0x0F):
        bench.run(sdo.Download(0x6040, 0, struct.pack("<H", word)))
    assert bench.drive.state is State.OPERATION_ENABLED


def test_a_ramp_that_ends_at_a_sync_of_a_stopped_node(bench) -> None:
    drive = moving(bench, 2)
    bench.control(0x02, Mode.CST)
    bench.nmt(nmt.Command.STOP)
    bench.sync(100 + BRAKE_DELAY_NS // MS + 1)
    assert drive.state is State.SWITCH_ON_DISABLED and drive.command().mode == 0
    bench.nmt(nmt.Command.ENTER_PRE_OPERATIONAL)
    assert bench.statusword == 0x0240
