"""The CiA 402 side of an emulated drive: every state with every command, modes, stops, faults, supervision."""

import itertools
import struct

import pytest

from emulator.axis import Command, Measurement
from protocols import cia402, emcy, nmt
from protocols.cia402 import CONTROLWORD, Mode, State
from protocols.sdo import Abort

MS = 1_000_000
STOPPED = Command(0, 0, 0.0)
MOVING = Measurement(1000, 3_276_800, 0.1)  # 25 motor revolutions per second: 100 ms of the default ramp


def bring_to(bench, state: State) -> None:
    """Put a drive that is on its bus into a state by the master's means."""
    bench.nmt(nmt.Command.START)
    bench.write(0x605A, 0, 6, 2)
    words = {
        State.SWITCH_ON_DISABLED: (),
        State.READY_TO_SWITCH_ON: (0x06,),
        State.SWITCHED_ON: (0x06, 0x07),
        State.OPERATION_ENABLED: (0x06, 0x0F),
        State.QUICK_STOP_ACTIVE: (0x06, 0x0F, 0x02),
        State.FAULT_REACTION_ACTIVE: (0x06, 0x0F),
        State.FAULT: (),
    }[state]
    for word in words:
        bench.control(word, Mode.CST)
    if state in {State.FAULT, State.FAULT_REACTION_ACTIVE}:
        bench.keep(bench.drive.fault(bench.t_ns, emcy.Code.OVERCURRENT))
    assert bench.drive.state is state


REACHABLE = [s for s in State if s is not State.NOT_READY_TO_SWITCH_ON]

# CiA 402-2, figure 4 and table 27, written out by hand: what is not here leaves the state alone.
EXPECTED = {
    (State.SWITCH_ON_DISABLED, 0x06): State.READY_TO_SWITCH_ON,
    (State.READY_TO_SWITCH_ON, 0x07): State.SWITCHED_ON,
    (State.READY_TO_SWITCH_ON, 0x0F): State.OPERATION_ENABLED,
    (State.READY_TO_SWITCH_ON, 0x00): State.SWITCH_ON_DISABLED,
    (State.READY_TO_SWITCH_ON, 0x02): State.SWITCH_ON_DISABLED,
    (State.SWITCHED_ON, 0x0F): State.OPERATION_ENABLED,
    (State.SWITCHED_ON, 0x06): State.READY_TO_SWITCH_ON,
    (State.SWITCHED_ON, 0x00): State.SWITCH_ON_DISABLED,
    (State.SWITCHED_ON, 0x02): State.SWITCH_ON_DISABLED,
    (State.OPERATION_ENABLED, 0x07): State.SWITCHED_ON,
    (State.OPERATION_ENABLED, 0x06): State.READY_TO_SWITCH_ON,
    (State.OPERATION_ENABLED, 0x00): State.SWITCH_ON_DISABLED,
    (State.OPERATION_ENABLED, 0x02): State.QUICK_STOP_ACTIVE,
    (State.QUICK_STOP_ACTIVE, 0x00): State.SWITCH_ON_DISABLED,
    (State.QUICK_STOP_ACTIVE, 0x0F): State.OPERATION_ENABLED,
    (State.FAULT, 0x80): State.SWITCH_ON_DISABLED,
}


@pytest.mark.parametrize(("state", "word"), list(itertools.product(REACHABLE, CONTROLWORD.values())))
def test_every_state_with_every_command(bench, state: State, word: int) -> None:
    bring_to(bench, state)
    bench.control(word, Mode.CST)
    expected = EXPECTED.get((state, word), state)
    assert bench.drive.state is expected
    assert cia402.state_of(bench.statusword) is expected


def test_statuswords_of_the_walk(bench) -> None:
    bench.nmt(nmt.Command.START)
    seen = [bench.statusword]
    for word in (0x06, 0x07, 0x0F, 0x02, 0x00):
        bench.control(word, 0)
        seen.append(bench.statusword)
    assert [f"{w:04X}" for w in seen] == ["0240", "0231", "0233", "0237", "0217", "0240"]


def test_statusword_changes_are_sent(bench) -> None:
    bench.nmt(nmt.Command.START)
    bench.wait(1)  # inhibit time after the one sent at the start
    sent = bench.control(0x06, 0)
    assert [(f.can_id, f.data[:2]) for f in sent] == [(0x285, b"\x31\x02")]


# --- modes ---


def test_mode_is_displayed_after_a_moment(bench) -> None:
    bench.nmt(nmt.Command.START)
    bench.control(0, Mode.CST)
    assert bench.read_int(0x6061) == 0
    bench.wait(1)
    bench.control(0, Mode.CST)  # repeating the request does not put it off
    bench.wait(1)
    assert bench.read_int(0x6061) == Mode.CST


@pytest.mark.parametrize("mode", [-1, 2, 5, 11])
def test_unsupported_modes(bench, mode: int) -> None:
    assert bench.refused(0x6060, 0, mode, 1) is Abort.VALUE
    assert bench.read_int(0x6502) == 0b11_1110_1101


def test_without_a_mode_the_power_stage_stays_off(bench) -> None:
    bench.nmt(nmt.Command.START)
    for word in (0x06, 0x07, 0x0F):
        bench.control(word, Mode.NONE)
    bench.target(torque=500)
    bench.sync(5)
    assert bench.drive.command().mode == 0


def test_torque_mode(bench) -> None:
    bench.enable(Mode.CST)
    bench.write(0x60B2, 0, -50, 2)
    bench.target(torque=300)
    assert bench.drive.command().target_current_A == pytest.approx(-0.1)  # the target waits for its SYNC
    bench.sync()
    assert bench.drive.command() == Command(10, 0, pytest.approx(0.5))  # 250 per mille of 2 A
    assert bench.read_int(0x6074) == 250
    assert bench.statusword == 0x1237


def test_torque_limit(bench) -> None:
    bench.enable(Mode.CST)
    bench.write(0x6072, 0, 200, 2)
    for target, current in ((300, 0.4), (-300, -0.4)):
        bench.target(torque=target)
        bench.sync()
        assert bench.drive.command().target_current_A == pytest.approx(current)
        assert bench.statusword == 0x1A37
    bench.target(torque=100)
    bench.sync()
    assert bench.statusword == 0x1237


def test_position_mode(bench) -> None:
    bench.enable(Mode.CSP)
    bench.write(0x60B0, 0, 7, 4)
    bench.target(position=-1000)
    bench.sync()
    assert bench.drive.command() == Command(8, -993, 0.0)
    assert bench.statusword == 0x1237


def test_power_is_off_in_every_other_state(bench) -> None:
    bench.enable(Mode.CST)
    bench.target(torque=300)
    bench.sync()
    for word in (0x07, 0x06, 0x00):
        bench.control(word, Mode.CST)
        assert bench.drive.command() == STOPPED


def test_speed_limit_of_torque_modes(bench) -> None:
    bench.write(0x6080, 0, 600, 4)  # 10 revolutions per second
    bench.enable(Mode.CST)
    for speed, torque, current in ((9, 100, 0.2), (11, 100, 0.0), (11, -100, -0.2), (-11, -100, 0.0)):
        bench.measurement = Measurement(0, speed * 131_072, 0.0)
        bench.target(torque=torque)
        bench.sync()
        assert bench.drive.command().target_current_A == pytest.approx(current)


def test_torque_limits_of_each_direction(bench) -> None:
    bench.write(0x60E0, 0, 100, 2)
    bench.write(0x60E1, 0, 50, 2)
    bench.enable(Mode.CST)
    for torque, current in ((300, 0.2), (-300, -0.1), (70, 0.14)):
        bench.target(torque=torque)
        bench.sync()
        assert bench.drive.command().target_current_A == pytest.approx(current)


def test_current_limit_of_the_power_stage(bench) -> None:
    assert bench.drive.changed_limit() == 8.0
    assert bench.drive.changed_limit() is None
    bench.write(0x6073, 0, 1500, 2)
    assert bench.drive.changed_limit() == 3.0
    bench.write(0x6073, 0, 60_000, 2)
    bench.write(0x6072, 0, 60_000, 2)
    assert bench.drive.changed_limit() == 8.0  # what the hardware can


def test_software_position_limits(bench) -> None:
    bench.write(0x607D, 1, -100, 4)
    bench.write(0x607D, 2, 200, 4)
    bench.enable(Mode.CSP)
    for target, reached, status in ((150, 150, 0x1237), (201, 200, 0x1A37), (-300, -100, 0x1A37)):
        bench.target(position=target)
        bench.sync()
        assert bench.drive.command().target_position == reached
        assert bench.statusword == status
    bench.write(0x607D, 1, 0, 4)
    bench.write(0x607D, 2, 0, 4)  # off
    bench.sync()
    assert bench.drive.command().target_position == -300


def test_interpolation_between_slow_targets(bench) -> None:
    bench.write(0x60C2, 1, 4, 1)
    bench.enable(Mode.CSP)
    seen = []
    for target in (40, 80):
        bench.target(position=target)
        for _ in range(4):
            bench.sync()
            seen.append(bench.drive.command().target_position)
    assert seen == pytest.approx([10, 20, 30, 40, 50, 60, 70, 80])


def test_current_in_milliamperes(bench) -> None:
    bench.measurement = Measurement(0, 0, -0.123456)
    bench.sync()
    assert bench.read_int(0x2078, signed=True) == -123


# --- what is measured ---


def test_latched_values(bench) -> None:
    bench.nmt(nmt.Command.START)
    bench.measurement = Measurement(-123_456, 789, -1.2345)
    bench.sync(3)
    assert bench.read_int(0x6064, signed=True) == bench.read_int(0x6063, signed=True) == -123_456
    assert bench.read_int(0x606C, signed=True) == 789
    assert bench.read_int(0x6078, signed=True) == bench.read_int(0x6077, signed=True) == -617
    assert bench.read_int(0x2001) == 3


def test_values_beyond_their_objects(bench) -> None:
    bench.nmt(nmt.Command.START)
    bench.measurement = Measurement(2**31 + 5, 2**40, 1e6)
    bench.sync()
    assert bench.read_int(0x6064, signed=True) == -(2**31) + 5  # an encoder counts on from its other end
    assert bench.read_int(0x606C, signed=True) == 2**31 - 1
    assert bench.read_int(0x6078, signed=True) == 32767


def test_cycle_counter_wraps_and_stops_with_the_node(bench) -> None:
    bench.sync(65_536 + 2)
    assert bench.read_int(0x2001) == 2
    bench.nmt(nmt.Command.STOP)
    bench.sync(5)
    bench.nmt(nmt.Command.START)
    assert bench.read_int(0x2001) == 2


def test_parameters_of_the_axis(bench) -> None:
    assert bench.read_int(0x6075) == 2000  # mA
    assert bench.read_int(0x6076) == 625  # mN·m: 10 N·m/A over a gear of 32, at 2 A
    assert bench.read_int(0x6073) == bench.read_int(0x6072) == 4000
    assert struct.unpack("<f", bench.read(0x2002)) == (10.0,)
    assert (bench.read_int(0x6091, 1), bench.read_int(0x6091, 2)) == (32, 1)
    assert bench.read_int(0x608F, 1) == 131_072


def test_current_loop_gains(bench) -> None:
    kr, tn_s = bench.drive.current_gains()
    assert kr == pytest.approx(2 * 3.141592653589793 * 600 * 0.002) and tn_s == pytest.approx(0.002)
    assert bench.drive.changed_gains() == (kr, tn_s)
    assert bench.drive.changed_gains() is None
    bench.write_bytes(0x2010, 0, struct.pack("<f", 12.5))
    bench.write_bytes(0x2011, 0, struct.pack("<f", 4.0))
    assert bench.drive.changed_gains() == pytest.approx((12.5, 0.004))
    assert bench.drive.changed_gains() is None
    bench.nmt(nmt.Command.RESET_NODE)
    assert bench.drive.changed_gains() == pytest.approx((kr, tn_s))
