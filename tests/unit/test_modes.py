"""Modes of operation with an ideal axis: it is always where the power stage was told to be."""

import itertools

import pytest

from emulator.axis import PROBE_INPUT, Measurement
from emulator.homing import index_passed
from protocols.cia402 import Homing, Mode
from protocols.sdo import Abort

TURN = 131_072
ENABLE, START, IMMEDIATELY, RELATIVE, HALT = 0x0F, 0x10, 0x20, 0x40, 0x100
REACHED, LIMITED, BIT12, BIT13 = 0x400, 0x800, 0x1000, 0x2000


def follow(bench, milliseconds: int) -> list[float]:
    """Positions of an axis that follows its commands, one per millisecond."""
    path = []
    for _ in range(milliseconds):
        target = bench.drive.command().target_position if bench.drive.command().mode == 8 else bench.measurement[0]
        velocity = round((target - bench.measurement.position) * 1000)
        bench.measurement = Measurement(round(target), velocity, 0.0)
        bench.sync()
        path.append(bench.drive.axis.reference.position)
    return path


def bits(bench) -> int:
    return bench.statusword & (REACHED | LIMITED | BIT12 | BIT13)


def control(bench, word: int, mode: Mode) -> None:
    bench.control(ENABLE | word, mode)
    bench.sync()


@pytest.fixture
def position(bench):
    """Profile position with 10 turns/s and 100 turns/s²."""
    bench.enable(Mode.PROFILE_POSITION)
    bench.sync()
    return bench


def go(bench, target: int, word: int = 0) -> None:
    bench.write(0x607A, 0, target, 4)
    control(bench, 0, Mode.PROFILE_POSITION)
    control(bench, START | word, Mode.PROFILE_POSITION)


# --- profile position ---


def test_a_move_is_trapezoidal_and_ends_where_it_should(position) -> None:
    go(position, 5 * TURN)
    assert bits(position) == BIT12  # acknowledged
    path = follow(position, 700)
    speed = [1000 * (b - a) for a, b in itertools.pairwise(path)]
    assert max(speed) == pytest.approx(10 * TURN)
    rates = [1000 * (b - a) for a, b in itertools.pairwise(speed)]
    assert max(rates) < 101 * TURN and min(rates) > -101 * TURN
    assert path[-1] == 5 * TURN == pytest.approx(max(path), abs=1e-6)
    arrival = next(k for k, p in enumerate(path) if p == 5 * TURN)
    assert arrival == pytest.approx(600, abs=5)  # 5 turns at 10 turns/s, 100 ms of each ramp counted half
    assert bits(position) == REACHED | BIT12
    control(position, 0, Mode.PROFILE_POSITION)
    assert bits(position) == REACHED


def test_backwards_and_a_short_way(position) -> None:
    go(position, -TURN // 10)
    path = follow(position, 200)
    assert path[-1] == -TURN // 10 == min(path)


def test_a_second_set_point_waits_for_the_first(position) -> None:
    go(position, TURN)
    go(position, 2 * TURN)
    control(position, 0, Mode.PROFILE_POSITION)
    assert bits(position) & BIT12  # the buffer is full
    go(position, 9 * TURN)  # there is no room for a third
    control(position, 0, Mode.PROFILE_POSITION)
    path = follow(position, 700)
    assert TURN in path and path[-1] == 2 * TURN
    assert not bits(position) & BIT12


def test_a_set_point_that_does_not_wait(position) -> None:
    go(position, 5 * TURN)
    follow(position, 100)
    go(position, 0, IMMEDIATELY)
    path = follow(position, 600)
    assert max(path) < 2 * TURN and path[-1] == 0


def test_relative_set_points(position) -> None:
    for _ in range(2):
        go(position, TURN, RELATIVE)
        follow(position, 400)
    assert position.drive.axis.reference.position == 2 * TURN


def test_set_points_beyond_the_software_limits(position) -> None:
    position.write(0x607D, 2, TURN, 4)
    go(position, 5 * TURN)
    assert bits(position) & LIMITED
    assert follow(position, 400)[-1] == TURN


def test_halt_stops_a_move_and_lets_it_go_on(position) -> None:
    go(position, 5 * TURN)
    follow(position, 200)
    control(position, HALT, Mode.PROFILE_POSITION)
    assert not bits(position) & REACHED
    path = follow(position, 150)
    assert path[-1] == path[-20] < 5 * TURN
    assert bits(position) & REACHED  # in a halt: at rest
    control(position, 0, Mode.PROFILE_POSITION)
    assert follow(position, 800)[-1] == 5 * TURN


@pytest.mark.parametrize(("option", "milliseconds"), [(1, 100), (2, 40)])
def test_halt_options(position, option: int, milliseconds: int) -> None:
    position.write(0x605D, 0, option, 2)
    go(position, 50 * TURN)
    follow(position, 300)
    control(position, HALT, Mode.PROFILE_POSITION)
    path = follow(position, milliseconds + 5)
    moving = sum(a != b for a, b in itertools.pairwise(path))
    assert moving == pytest.approx(milliseconds, abs=3)


def test_max_profile_velocity(position) -> None:
    position.write(0x607F, 0, 2 * TURN, 4)
    go(position, 5 * TURN)
    path = follow(position, 300)
    assert path[-1] - path[-2] == pytest.approx(2 * TURN / 1000)


def test_following_error_of_a_blocked_axis(position, emergencies) -> None:
    go(position, 5 * TURN)
    position.sync(400)  # the measurement stays
    assert emergencies(position.log) == [(0x8611, 0x21)]


# --- velocity ---


def test_profile_velocity(bench) -> None:
    bench.enable(Mode.PROFILE_VELOCITY)
    follow(bench, 20)
    assert bits(bench) == REACHED | BIT12  # target 0, standing
    bench.write(0x60FF, 0, -5 * TURN, 4)
    path = follow(bench, 30)
    assert bits(bench) == 0
    path += follow(bench, 70)
    speed = [1000 * (b - a) for a, b in itertools.pairwise(path)]
    assert speed[-1] == pytest.approx(-5 * TURN) and bits(bench) == REACHED
    assert sum(s > -4.99 * TURN for s in speed) == pytest.approx(50, abs=3)  # 100 turns/s²
    control(bench, HALT, Mode.PROFILE_VELOCITY)
    follow(bench, 100)
    assert bits(bench) == REACHED | BIT12
    bench.write(0x607F, 0, TURN, 4)
    control(bench, 0, Mode.PROFILE_VELOCITY)
    follow(bench, 100)
    assert bits(bench) == REACHED | LIMITED


def test_cyclic_velocity(bench) -> None:
    bench.enable(Mode.CSV)
    bench.write(0x60FF, 0, 3000, 4)
    bench.write(0x60B1, 0, -1000, 4)
    path = follow(bench, 50)
    assert path[-1] - path[-2] == pytest.approx(2.0)
    assert bench.statusword == 0x1237


def test_a_blocked_axis_does_not_catch_up(bench) -> None:
    bench.write(0x6065, 0, 500, 4)
    bench.enable(Mode.CSV)
    bench.write(0x60FF, 0, 100_000, 4)
    bench.sync(100)
    assert bench.drive.axis.reference.position == 500


# --- torque ---


def test_profile_torque_has_a_slope(bench) -> None:
    bench.write(0x6087, 0, 5000, 4)
    bench.enable(Mode.PROFILE_TORQUE)
    bench.target(torque=50)
    currents = []
    for _ in range(12):
        bench.sync()
        currents.append(bench.drive.command().target_current_A * 500)
    assert currents == pytest.approx([5, 10, 15, 20, 25, 30, 35, 40, 45, 50, 50, 50])
    assert bits(bench) == REACHED
    control(bench, HALT, Mode.PROFILE_TORQUE)
    bench.sync(4)
    assert bench.drive.command().target_current_A * 500 == pytest.approx(25)
    bench.sync(5)
    assert bits(bench) == REACHED


# --- interpolated position ---


def test_interpolated_position(bench) -> None:
    bench.write(0x60C2, 1, 2, 1)
    bench.enable(Mode.INTERPOLATED_POSITION)
    bench.write(0x60C1, 1, 100, 4)
    assert follow(bench, 5)[-1] == 0  # not enabled yet
    assert bits(bench) == REACHED
    bench.control(ENABLE | START, Mode.INTERPOLATED_POSITION)
    assert follow(bench, 3) == pytest.approx([50, 100, 100])
    assert bits(bench) == BIT12
    bench.control(ENABLE | START | HALT, Mode.INTERPOLATED_POSITION)
    bench.write(0x60C1, 1, 200, 4)
    follow(bench, 5)
    assert bits(bench) == REACHED and bench.drive.axis.reference.position == 100


# --- homing ---


def home(bench, method: Homing, offset: int = 0, milliseconds: int = 4000) -> int:
    """Encoder counts of the zero found."""
    bench.write(0x6098, 0, method, 1)
    bench.write(0x607C, 0, offset, 4)
    bench.enable(Mode.HOMING)
    follow(bench, 2)
    assert bits(bench) & (BIT12 | BIT13) == 0
    bench.control(ENABLE | START, Mode.HOMING)
    follow(bench, milliseconds)
    assert bits(bench) == BIT12 | REACHED
    assert bench.read_int(0x6063, signed=True) - bench.read_int(0x6064, signed=True) == bench.drive.axis.zero
    return bench.drive.axis.zero


@pytest.mark.parametrize("method", [Homing.CURRENT_POSITION, Homing.CURRENT_POSITION_OLD])
def test_homing_where_the_axis_is(bench, method: Homing) -> None:
    bench.measurement = Measurement(5555, 0, 0.0)
    assert home(bench, method, offset=55) == 5500
    follow(bench, 1)
    assert bench.read_int(0x6064) == 55


@pytest.mark.parametrize(("method", "index"), [(Homing.POSITIVE_INDEX, 2), (Homing.NEGATIVE_INDEX, 1)])
def test_homing_on_the_index_pulse(bench, method: Homing, index: int) -> None:
    bench.measurement = Measurement(TURN + 20_000, 0, 0.0)
    assert home(bench, method) == index * TURN


@pytest.mark.parametrize(
    ("method", "zero"),
    [
        (Homing.NEGATIVE_LIMIT, -200_000),
        (Homing.POSITIVE_LIMIT, 300_000),
        (Homing.NEGATIVE_LIMIT_AND_INDEX, -TURN),
        (Homing.POSITIVE_LIMIT_AND_INDEX, 2 * TURN),
    ],
)
def test_homing_on_limit_switches(make_bench, method: Homing, zero: int) -> None:
    bench = make_bench(travel=(-200_000, 300_000))
    found = home(bench, method, milliseconds=9000)
    assert found == pytest.approx(zero, abs=200)
    if method in {Homing.NEGATIVE_LIMIT_AND_INDEX, Homing.POSITIVE_LIMIT_AND_INDEX}:
        assert found == zero


def test_homing_that_cannot_be(bench) -> None:
    assert bench.refused(0x6098, 0, 3, 1) is Abort.VALUE
    bench.write(0x6098, 0, Homing.NEGATIVE_LIMIT, 1)  # this axis has no switches
    bench.enable(Mode.HOMING)
    control(bench, START, Mode.HOMING)
    assert bits(bench) == BIT13 | REACHED


def test_homing_interrupted(bench) -> None:
    bench.write(0x6098, 0, Homing.POSITIVE_INDEX, 1)
    bench.measurement = Measurement(1, 0, 0.0)
    bench.enable(Mode.HOMING)
    control(bench, START, Mode.HOMING)
    follow(bench, 100)
    assert bits(bench) == 0  # in progress
    control(bench, START | HALT, Mode.HOMING)
    follow(bench, 200)
    assert bits(bench) == REACHED and bench.drive.axis.zero == 0


def test_targets_after_homing_count_from_the_new_zero(bench) -> None:
    bench.measurement = Measurement(5555, 0, 0.0)
    home(bench, Homing.CURRENT_POSITION)
    bench.control(ENABLE, Mode.CSP)
    bench.target(position=10)
    follow(bench, 5)
    bench.target(position=10)
    follow(bench, 2)
    assert bench.drive.command().target_position == 5565


def test_index_pulses_are_passed_once() -> None:
    assert index_passed(10, 10, 100) is None
    assert index_passed(99, 100, 100) == 100
    assert index_passed(100, 101, 100) is None
    assert index_passed(101, 100, 100) == 100
    assert index_passed(100, 99, 100) is None
    assert index_passed(-1, 1, 100) == 0 == index_passed(1, -1, 100)


# --- changes of mode ---


def test_a_change_of_mode_in_motion_does_not_jump(bench) -> None:
    bench.enable(Mode.PROFILE_VELOCITY)
    bench.write(0x60FF, 0, 5 * TURN, 4)
    follow(bench, 100)
    before = bench.drive.axis.reference.position
    bench.control(ENABLE, Mode.PROFILE_POSITION)
    path = follow(bench, 200)
    assert path[0] - before == pytest.approx(5 * TURN / 1000, rel=0.05)
    assert bench.read_int(0x6061) == Mode.PROFILE_POSITION
    assert path[-1] == path[-50]  # no set-point: it has stopped


def test_every_mode_is_displayed_and_holds_still_without_a_target(bench) -> None:
    bench.enable(Mode.PROFILE_POSITION)
    for mode in list(Mode)[1:]:
        bench.control(ENABLE, mode)
        assert bench.read_int(0x6061) == bench.drive._mode.code != mode or mode is Mode.PROFILE_POSITION
        path = follow(bench, 10)
        assert bench.read_int(0x6061) == mode
        assert path[-1] == 0 and bench.drive.command().target_current_A == 0


# --- touch probe and digital inputs ---


def test_probe_on_an_input(bench) -> None:
    axis = bench.drive.axis
    bench.write(0x60B8, 0, 0x31, 2)
    assert bench.read_int(0x60B9) == 1
    for position, level in ((10, 0), (20, 1), (30, 1), (40, 0), (50, 1), (60, 0)):
        axis.inputs = PROBE_INPUT * level
        bench.measurement = Measurement(position, 0, 0.0)
        bench.sync()
    assert (bench.read_int(0x60BA), bench.read_int(0x60BB), bench.read_int(0x60B9)) == (20, 40, 7)  # the first edges
    bench.write(0x60B8, 0, 0, 2)
    assert bench.read_int(0x60B9) == 0


def test_probe_on_index_pulses(bench) -> None:
    bench.write(0x60B8, 0, 0x17, 2)  # every pulse
    for position in (100, TURN + 50, 2 * TURN + 7):
        bench.measurement = Measurement(position, 0, 0.0)
        bench.sync()
    assert bench.read_int(0x60BA) == 2 * TURN and bench.read_int(0x60B9) == 3


def test_limit_switches_are_digital_inputs(make_bench) -> None:
    bench = make_bench(travel=(-10, 10))
    for position, closed in ((-11, 1), (-10, 1), (0, 0), (10, 2)):
        bench.measurement = Measurement(position, 0, 0.0)
        bench.sync()
        assert bench.read_int(0x60FD) == closed


def test_modes_go_on_without_sync(bench) -> None:
    bench.write(0x2003, 0, 0, 2)  # no supervision
    bench.enable(Mode.PROFILE_POSITION)
    go(bench, TURN // 4)
    for _ in range(200):
        bench.measurement = Measurement(round(bench.drive.command().target_position), 0, 0.0)
        bench.wait(1)
    assert bench.measurement.position == TURN // 4
