"""Each emulated effect against a closed form, on an axis without gravity unless it says so."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.effects.friction import bristles
from emulator.plant import Plant
from protocols.effectentries import parse_effect
from protocols.robot import Control, Drive, Joint, Parameters, Robot

Floats = NDArray[np.float64]

PERIOD_S = 1e-3
CST, CSP, OFF = 10, 8, 0
INERTIA = 0.5  # kg·m², link and rotor
COULOMB, VISCOUS = 5.0, 2.0
G = 9.81
# 1 A is 10 N·m at once, without back-EMF that would matter.
DRIVE = Drive(
    gear_ratio=10.0,
    drive_gain_Nm_A=10.0,
    rated_current_A=5.0,
    max_current_A=50.0,
    current_bandwidth_Hz=1e6,
    resistance_Ohm=100.0,
    inductance_H=0.2,
    bus_voltage_V=1e9,
)


def axis(name: str = "a", kind: str = "revolute", **parameters: Any) -> Joint:
    chosen = {
        "inertia_kgm2": (0.0, 0.0, 0.0, 0.0, 0.0, 0.4),
        "rotor_inertia_kgm2": 0.1,
        "coulomb_Nm": COULOMB,
        "viscous_Nms_rad": VISCOUS,
    } | parameters
    return Joint(
        name=name,
        kind="prismatic" if kind == "prismatic" else "revolute",
        position_min_rad=-10.0,
        position_max_rad=10.0,
        velocity_max_rad_s=5.0,
        torque_max_Nm=200.0,
        drive=DRIVE,
        control=Control(natural_frequency_rad_s=100.0, inertia_kgm2=INERTIA),
        parameters=Parameters(**chosen),
    )


def robot(*effects: str, joint: Joint | None = None) -> Robot:
    return Robot(name="one", joint=[joint or axis()], effect=[parse_effect(text) for text in effects])


def plant_of(arm: Robot, **keys: Any) -> Plant:
    J = arm.joints
    return Plant(arm, PERIOD_S, np.random.default_rng(1), np.zeros(J), np.zeros(J), **keys)


def follow(plant: Plant, arm: Robot, path: Floats) -> tuple[Floats, Floats, Floats]:
    """CSP along joint positions, shape (T, J): encoder positions, currents, true positions."""
    J = arm.joints
    seen, current, true = np.empty(path.shape), np.empty(path.shape), np.empty(path.shape)
    for n, target in enumerate(arm.motor_counts(path)):
        plant.advance(np.full(J, CSP), target, np.zeros(J))
        counts, _, current[n] = plant.measure()
        seen[n], true[n] = arm.joint_position(counts), plant.q
    return seen, current, true


def push(plant: Plant, currents: Any, mode: int = CST) -> Floats:
    """CST with one row of currents per period; joint positions, shape (T, J)."""
    J = len(plant.q)
    positions = []
    for current in currents:
        plant.advance(np.full(J, mode), np.zeros(J), np.broadcast_to(np.asarray(current, dtype=float), J).copy())
        positions.append(plant.q.copy())
    return np.array(positions)


def torque_at_speed(
    speed: float, *effects: str, joint: Joint | None = None, prepare: Callable[[Plant], None] | None = None
) -> float:
    """Drive torque of steady motion [N·m]."""
    arm = robot(*effects, joint=joint)
    plant = plant_of(arm)
    if prepare is not None:
        prepare(plant)
    path = speed * PERIOD_S * np.arange(1, 1201)[:, None]
    return float(follow(plant, arm, path)[1][-200:].mean() * 10.0)


# --- friction ---


@pytest.mark.parametrize("exponent", [1.0, 2.0])
@pytest.mark.parametrize("speed", [0.02, 0.05, 0.15, -0.05])
def test_stribeck_falls_with_speed_as_tustin_and_gauss_say(speed: float, exponent: float) -> None:
    effect = f"friction.stribeck@a:stiction_Nm=4,velocity_rad_s=0.05,exponent={exponent}"
    excess = 4 * np.exp(-((abs(speed) / 0.05) ** exponent))
    expected = np.sign(speed) * (COULOMB + excess + VISCOUS * abs(speed))
    assert torque_at_speed(speed, effect) == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize(("torque", "moves"), [(8.9, False), (9.1, True)])
def test_stiction_is_overcome_at_coulomb_plus_stiction(torque: float, moves: bool) -> None:
    plant = plant_of(robot("friction.stribeck@a:stiction_Nm=4,velocity_rad_s=0.05"))
    travel = push(plant, np.full(500, torque / 10))[-1, 0]
    assert (travel > 0.05) == moves
    assert moves or abs(travel) < 1e-9


def test_friction_lags_behind_speed() -> None:
    """Frictional memory: at the same speed more friction while accelerating than while slowing down."""
    arm = robot("friction.stribeck@a:stiction_Nm=4,velocity_rad_s=0.3,lag_s=0.05", joint=axis(viscous_Nms_rad=0.0))
    t = PERIOD_S * np.arange(3000)
    path = 0.4 * t + 0.3 / 20 * (1 - np.cos(20 * t))  # speed 0.4 + 0.3 sin(20 t), never reversed
    plant = plant_of(arm)
    _, current, true = follow(plant, arm, path[:, None])
    speed = np.gradient(true[:, 0], PERIOD_S)
    friction = current[:, 0] * 10 - INERTIA * np.gradient(speed, PERIOD_S)
    tail = slice(1500, None)
    rising = np.gradient(speed)[tail] > 0
    near = np.abs(speed[tail] - 0.4) < 0.05
    assert friction[tail][near & rising].mean() > friction[tail][near & ~rising].mean() + 0.3


def test_asymmetry_adds_one_way_and_takes_the_other() -> None:
    up, down = (torque_at_speed(v, "friction.asymmetric@a:half_difference_Nm=1.5") for v in (0.5, -0.5))
    assert up == pytest.approx(COULOMB + 1.5 + VISCOUS * 0.5, abs=0.01)
    assert down == pytest.approx(-(COULOMB - 1.5 + VISCOUS * 0.5), abs=0.01)


@pytest.mark.parametrize("power", [0.4, 2.0, 3.0])
def test_nonlinear_viscous_friction_is_a_power_of_speed_well_above_the_knee(power: float) -> None:
    effect = f"friction.viscous_nonlinear@a:torque_Nm=3,velocity_rad_s=0.5,exponent={power}"
    added = {v: torque_at_speed(v, effect) - COULOMB - VISCOUS * v for v in (0.005, 0.01, 0.5, 1.0, 2.0)}
    assert added[0.5] == pytest.approx(3.0, abs=0.01)
    assert np.log2(added[2.0] / added[1.0]) == pytest.approx(power, abs=0.04 * abs(power - 1))
    assert np.log2(added[0.01] / added[0.005]) == pytest.approx(1.0, abs=0.1)  # linear at creep


LIFT = {"mass_kg": 4.0, "inertia_kgm2": (0.0,) * 6, "viscous_Nms_rad": 0.0}


def test_load_friction_is_a_share_of_the_weight_both_ways() -> None:
    lift = axis(kind="prismatic", **LIFT)
    up, down = (torque_at_speed(v, "friction.load@a:coefficient=0.2", joint=lift) for v in (0.2, -0.2))
    assert up == pytest.approx(4 * G + COULOMB + 0.2 * 4 * G, abs=0.05)
    assert down == pytest.approx(4 * G - COULOMB - 0.2 * 4 * G, abs=0.05)


def test_preloaded_flanks_hide_small_loads() -> None:
    lift = axis(kind="prismatic", **LIFT)
    up = torque_at_speed(0.2, "friction.load@a:coefficient=0.2,preload_Nm=30", joint=lift)
    assert up == pytest.approx(4 * G + COULOMB + 0.2 * (np.hypot(4 * G, 30) - 30), abs=0.05)


def test_efficiency_divides_when_driving_and_multiplies_when_braking() -> None:
    lift = axis(kind="prismatic", **LIFT | {"coulomb_Nm": 0.0})
    effect = "transmission.efficiency@a:driving=0.8,braking=0.7"
    up, down = (torque_at_speed(v, effect, joint=lift) for v in (0.2, -0.2))
    assert up == pytest.approx(4 * G / 0.8, rel=2e-3)
    assert down == pytest.approx(4 * G * 0.7, rel=2e-3)


def test_a_gear_that_loses_more_than_it_carries_is_self_locking() -> None:
    lift = axis(kind="prismatic", **LIFT | {"coulomb_Nm": 0.0})
    held = plant_of(robot("transmission.efficiency@a:driving=0.4,braking=0", joint=lift))
    falls = plant_of(robot("transmission.efficiency@a:driving=0.4,braking=0.5", joint=lift))
    assert abs(push(held, np.zeros(300))[-1, 0]) < 1e-6
    assert push(falls, np.zeros(300))[-1, 0] < -0.05


def test_warm_friction_is_lower_by_arrhenius() -> None:
    effect = "friction.temperature@a:viscous_per_K=-0.04,coulomb_per_K=-0.01,reference_C=22,time_constant_s=1e5"
    warm = torque_at_speed(1.0, effect, prepare=lambda p: p.warm_to(np.array([42.0])))
    assert warm == pytest.approx(COULOMB * np.exp(-0.2) + VISCOUS * np.exp(-0.8), abs=0.01)
    assert torque_at_speed(1.0, effect) == pytest.approx(COULOMB + VISCOUS, abs=0.01)


def test_friction_warms_its_lubricant_and_the_sensor_follows_late() -> None:
    arm = robot(
        "friction.temperature@a:viscous_per_K=0,coulomb_per_K=0,time_constant_s=1.0,rise_K_W=2,sensor_lag_s=0.5"
    )
    plant = plant_of(arm)
    power = (COULOMB + VISCOUS) * 1.0  # W at 1 rad/s
    shown = []
    for n in range(1, 3001):
        plant.advance(np.array([CSP]), arm.motor_counts(np.array([1.0 * n * PERIOD_S])), np.zeros(1))
        shown.append(plant.motor_temperature_C[0])
    t = PERIOD_S * np.arange(1, 3001)
    expected = 22 + 2 * power * (1 - (1.0 * np.exp(-t / 1.0) - 0.5 * np.exp(-t / 0.5)) / 0.5)  # two lags in a row
    assert np.abs(np.array(shown) - expected).max() < 0.02 * 2 * power
    assert shown[-1] > 22 + 0.85 * 2 * power


def creep(plant: Plant, torques: Floats) -> Floats:
    """Quasi-static: positions at slowly changing torques."""
    return push(plant, torques / 10)[:, 0]


SLIP = "friction.presliding@a:distance_rad=0.01,damping_Nms_rad=5"
STILL = axis(viscous_Nms_rad=0.0)


def test_presliding_follows_the_virgin_curve_and_breaks_away_at_coulomb() -> None:
    plant = plant_of(robot(SLIP, joint=STILL))
    torque = np.linspace(0, 0.98 * COULOMB, 8000)
    x = creep(plant, torque)
    limit, slide_at = bristles()
    virgin = [COULOMB * np.sum(limit * np.minimum(d / 0.01 / slide_at, 1.0)) for d in x]
    assert np.abs(virgin - torque).max() < 0.03 * COULOMB
    assert np.interp(0.01, x, torque) == pytest.approx((1 - np.exp(-1.0)) * COULOMB, rel=0.05)
    assert creep(plant, np.full(1000, 1.1 * COULOMB))[-1] > 0.3


def test_presliding_reverses_on_masings_curve_and_remembers_its_minor_loops() -> None:
    """Masing: unloading is the virgin curve twice as large. Nonlocal memory: after a closed minor loop the old path
    is followed as if nothing had happened."""
    plant = plant_of(robot(SLIP, joint=STILL))
    up, amplitude = (1 - np.cos(np.pi * np.linspace(0, 1, 6000))) / 2, 0.8 * COULOMB
    x_up = creep(plant, amplitude * up)
    x_down = creep(plant, amplitude * (1 - up))
    virgin = np.interp(amplitude * up / 2, amplitude * up, x_up)
    assert np.abs((x_up[-1] - x_down) - 2 * virgin).max() < 0.04 * x_up[-1]
    dip = 0.3 * COULOMB * np.sin(np.pi * np.linspace(0, 1, 4000)) ** 2
    back = creep(plant, dip)  # away from zero torque and back
    assert back[-1] == pytest.approx(x_down[-1], abs=0.02 * x_up[-1])
    again = creep(plant, amplitude * up)
    assert again[-1] == pytest.approx(x_up[-1], abs=0.02 * x_up[-1])


def test_a_worn_spot_is_where_it_is_said_and_as_wide() -> None:
    arm = robot("friction.position@a:amplitude_Nm=3,centre_rad=0.5,width_rad=0.1")
    path = 0.5 * PERIOD_S * np.arange(1, 2401)[:, None]
    _, current, true = follow(plant_of(arm), arm, path)
    added = current[:, 0] * 10 - COULOMB - VISCOUS * 0.5
    at = np.interp([0.5, 0.4, 0.6, 0.1, 1.0], true[:, 0], added)
    assert at == pytest.approx([3.0, 1.5, 1.5, 0.0, 0.0], abs=0.05)


# --- transmission ---


def elastic(effect: str = "transmission.elasticity@a:stiffness_Nm_rad=1000,damping_Nms_rad=0", **keys: Any) -> Robot:
    return robot(effect, joint=axis(**keys))


def spectrum_peak(x: Floats) -> float:
    """Frequency of the strongest line, from the phase advance between the two halves of the record [Hz]."""
    x = (x - x.mean()) * np.hanning(len(x))
    power = np.abs(np.fft.rfft(x, 16 * len(x)))
    return float(np.argmax(power) / (16 * len(x) * PERIOD_S))


def test_link_swings_at_the_locked_frequency_while_the_brake_holds_the_motor() -> None:
    plant = plant_of(elastic())
    push(plant, np.full(40, 3.0))
    q = push(plant, np.zeros(2000), OFF)[200:, 0]
    assert spectrum_peak(q) == pytest.approx(np.sqrt(1000 / 0.4) / (2 * np.pi), rel=2e-3)
    early, late = np.ptp(q[:500]), np.ptp(q[-500:])
    assert late == pytest.approx(early, rel=2e-3)  # without damping nothing is lost


def test_damping_of_the_shaft_ends_the_swing_at_its_rate() -> None:
    plant = plant_of(elastic("transmission.elasticity@a:stiffness_Nm_rad=1000,damping_Nms_rad=2"))
    push(plant, np.full(40, 3.0))
    q = push(plant, np.zeros(1500), OFF)[:, 0]
    q = q - q[-1]
    peaks = [np.abs(q[k : k + 150]).max() for k in (100, 728)]  # five swings apart
    assert peaks[1] / peaks[0] == pytest.approx(np.exp(-2 / (2 * 0.4) * 0.628), rel=0.03)


def test_free_motor_and_link_swing_against_each_other() -> None:
    plant = plant_of(elastic(coulomb_Nm=0.0, viscous_Nms_rad=0.0))
    push(plant, [1.0])
    counts = []
    for _ in range(1500):
        push(plant, [0.0])
        counts.append(plant.measure()[0][0])
    x = np.array(counts) / DRIVE.counts_per_rad
    x = x - np.polyval(np.polyfit(np.arange(1500), x, 1), np.arange(1500))
    assert spectrum_peak(x) == pytest.approx(np.sqrt(1000 * (1 / 0.4 + 1 / 0.1)) / (2 * np.pi), rel=2e-3)


def test_the_encoder_sees_the_motor_not_the_link() -> None:
    lift = axis(kind="prismatic", **LIFT)
    arm = robot("transmission.elasticity@a:stiffness_Nm_rad=2000,damping_Nms_rad=50", joint=lift)
    plant = plant_of(arm)
    push(plant, np.zeros(500), OFF)
    seen = arm.joint_position(plant.measure()[0])[0]
    assert seen - plant.q[0] == pytest.approx(4 * G / 2000, rel=1e-3)


def test_hardening_raises_the_frequency_as_duffing_says() -> None:
    """Duffing, first order of the amplitude: w² = K/J (1 + 3/4 (c/K) A²)."""
    plant = plant_of(elastic("transmission.elasticity@a:stiffness_Nm_rad=1000,damping_Nms_rad=0,cubic_Nm_rad3=2e6"))
    push(plant, np.full(30, 2.0))
    q = push(plant, np.zeros(3000), OFF)[200:, 0]
    amplitude = np.ptp(q) / 2
    stretch = 1 + 0.75 * 2e6 / 1000 * amplitude**2
    assert stretch > 1.1
    assert spectrum_peak(q) == pytest.approx(np.sqrt(1000 / 0.4 * stretch) / (2 * np.pi), rel=0.02)


def test_play_lets_the_link_move_freely_between_the_flanks() -> None:
    joint = axis(kind="prismatic", **LIFT)
    arm = robot("transmission.backlash@a:gap_rad=0.01,stiffness_Nm_rad=1e5,damping_Nms_rad=300", joint=joint)
    plant = plant_of(arm)
    push(plant, np.zeros(300), OFF)
    hanging = plant.q[0]
    seen = arm.joint_position(plant.measure()[0])[0]
    assert seen - hanging == pytest.approx(0.005 + 4 * G / 1e5, rel=0.01)
    slow = seen + 0.02 * PERIOD_S * np.arange(1, 1501)[:, None]
    lifted, current, true = follow(plant, arm, slow)
    assert (lifted - true)[-1, 0] == pytest.approx(seen - hanging, rel=0.01)  # weight keeps it on one flank
    assert current[-1, 0] * 10 == pytest.approx(4 * G + COULOMB, rel=0.02)


def test_motion_is_lost_at_each_reversal_by_the_gap() -> None:
    arm = robot("transmission.backlash@a:gap_rad=0.02,stiffness_Nm_rad=1e5,damping_Nms_rad=200")
    t = PERIOD_S * np.arange(8000)
    path = 0.3 * np.sin(2 * np.pi * 0.25 * t)[:, None]
    seen, _, true = follow(plant_of(arm), arm, path)
    lead = (seen - true)[4000:, 0]
    speed = np.gradient(true[4000:, 0])
    fast = np.abs(speed) > 0.5 * np.abs(speed).max()
    assert np.median(lead[fast & (speed > 0)]) == pytest.approx(-np.median(lead[fast & (speed < 0)]), abs=2e-3)
    assert np.ptp(lead) == pytest.approx(0.02, rel=0.1)


def two_axes(*effects: str, **keys: Any) -> Robot:
    """Frames coincide, so that links do not couple; the first link has no inertia of its own."""
    still = {"coulomb_Nm": 0.0, "viscous_Nms_rad": 0.0, "inertia_kgm2": (0.0,) * 6} | keys
    return Robot(
        name="two", joint=[axis("a", **still), axis("b", **still)], effect=[parse_effect(text) for text in effects]
    )


def test_shared_parts_rub_on_the_sum_of_both_speeds() -> None:
    arm = two_axes("transmission.coupling@b:viscous_Nms_rad=2,coulomb_Nm=1")
    t = PERIOD_S * np.arange(1, 1501)
    path = np.stack([0.5 * t, 0.25 * t], axis=1)
    torque = follow(plant_of(arm), arm, path)[1][-200:].mean(axis=0) * 10
    assert torque == pytest.approx([1 + 2 * 0.75] * 2, abs=0.01)
    opposite = np.stack([0.5 * t, -0.5 * t], axis=1)
    torque = follow(plant_of(arm), arm, opposite)[1][-200:].mean(axis=0) * 10
    assert torque == pytest.approx([0.0, 0.0], abs=0.02)


def test_shared_inertia_couples_accelerations() -> None:
    plant = plant_of(two_axes("transmission.coupling@b:coulomb_Nm=0,inertia_kgm2=0.3"))
    push(plant, np.tile([0.1, 0.0], (100, 1)))
    expected = np.linalg.solve(0.1 * np.eye(2) + 0.3 * np.ones((2, 2)), [1.0, 0.0]) * 0.1
    assert plant.qd == pytest.approx(expected, rel=2e-3)


# --- motor and drive ---


@pytest.mark.parametrize("speed", [0.2, 0.6])
def test_ripple_has_its_amplitude_and_order_at_any_speed(speed: float) -> None:
    arm = robot("motor.ripple@a:amplitude_Nm=1.2,order=3,second_Nm=0.4")
    path = speed * PERIOD_S * np.arange(1, 8001)[:, None]
    _, current, true = follow(plant_of(arm), arm, path)
    q, tau = true[2000:, 0], current[2000:, 0] * 10
    speeds = np.gradient(q, PERIOD_S)
    tau = tau - INERTIA * np.gradient(speeds, PERIOD_S) - VISCOUS * speeds
    columns = np.stack([f(k * 30 * q) for k in (1, 2) for f in (np.sin, np.cos)] + [np.ones_like(q)], axis=1)
    found = np.linalg.lstsq(columns, tau, rcond=None)[0]
    assert found[:4] == pytest.approx([-1.2, 0.0, -0.4, 0.0], abs=0.05)


def test_current_proportional_ripple_grows_with_current() -> None:
    heavy = axis(rotor_inertia_kgm2=1e6, coulomb_Nm=0.0)
    still = robot("motor.ripple@a:amplitude_Nm=0,order=1,phase_rad=1.5707963,per_current_Nm_A=0.5", joint=heavy)
    plant = plant_of(still)
    push(plant, np.full(1000, 4.0))
    assert plant.qd[0] * 1e6 == pytest.approx(4.0 * 10.5, rel=1e-3)  # 1 s at the crest


@pytest.mark.parametrize("current", [-20.0, 4.0, 20.0])
def test_torque_is_lost_at_large_current_alone(current: float) -> None:
    heavy = axis(rotor_inertia_kgm2=1e6, coulomb_Nm=0.0)
    plant = plant_of(robot("motor.saturation@a:loss=0.2,current_A=20", joint=heavy))
    push(plant, np.full(1000, current))
    knee = 20 / 0.8873  # tanh(x)/x = 0.8 at x = 0.8873
    assert plant.qd[0] * 1e6 == pytest.approx(10 * knee * np.tanh(current / knee), rel=2e-3)
    if abs(current) == 20:
        assert abs(plant.qd[0]) * 1e6 == pytest.approx(160.0, rel=2e-3)


def test_a_wrong_gain_scales_torque_and_back_emf_but_not_what_the_drive_reports() -> None:
    arm = robot("drive.gain@a:error=0.25", joint=axis(coulomb_Nm=0.0, viscous_Nms_rad=0.0))
    plant = plant_of(arm)
    push(plant, np.full(100, 1.0))
    assert plant.qd[0] == pytest.approx(12.5 / INERTIA * 0.1, rel=2e-3)
    assert plant.measure()[2][0] == pytest.approx(1.0, rel=1e-3)
    assert arm.joint[0].drive.drive_gain_Nm_A == 10.0


@pytest.mark.parametrize(
    ("effect", "expected_s"), [("delay_s=0.00235", 0.00235), ("delay_s=0.001,filter_s=0.002", 0.003)]
)
def test_currents_are_reported_late(effect: str, expected_s: float) -> None:
    blocked = axis(rotor_inertia_kgm2=1e9)
    t = PERIOD_S * np.arange(4000)
    wave = 2.0 * np.sin(2 * np.pi * 5.0 * t)
    phases = []
    for effects in ((), (f"drive.delay@a:{effect}",)):
        plant = plant_of(robot(*effects, joint=blocked))
        found = []
        for current in wave:
            push(plant, [current])
            found.append(plant.measure()[2][0])
        phases.append(np.angle(np.mean(np.array(found)[1000:] * np.exp(-2j * np.pi * 5.0 * t[1000:]))))
    assert (phases[0] - phases[1]) / (2 * np.pi * 5.0) == pytest.approx(expected_s, rel=0.01)


def test_an_offset_of_the_sensor_is_regulated_into_the_motor() -> None:
    plant = plant_of(robot("drive.current_offset@a:offset_A=0.3", joint=axis(coulomb_Nm=0.0, viscous_Nms_rad=0.0)))
    push(plant, np.zeros(100))
    assert plant.measure()[2][0] == pytest.approx(0.0, abs=1e-6)  # the drive believes there is none
    assert plant.qd[0] == pytest.approx(-3.0 / INERTIA * 0.1, rel=2e-3)


def test_an_eccentric_disc_errs_by_its_amplitude_once_per_turn() -> None:
    arm = robot("sensor.eccentricity@a:amplitude_rad=0.01,phase_rad=0.7", joint=axis(coulomb_Nm=0.0))
    path = 0.5 * PERIOD_S * np.arange(1, 4001)[:, None]
    seen, _, true = follow(plant_of(arm), arm, path)
    turn = 10 * true[:, 0] + 0.7
    e = 0.01 * 10
    expected = sum((-1) ** (k + 1) * e**k * np.sin(k * turn) / k for k in range(1, 6)) / 10  # series of the geometry
    assert np.abs((seen - true)[:, 0] - expected).max() < 2e-5


# --- outside ---


def test_a_spring_holds_the_load_where_hooke_says() -> None:
    arm = robot("spring@a:stiffness_Nm_rad=40,centre_rad=0.2,cubic_Nm_rad3=30", joint=axis(coulomb_Nm=0.0))
    path = np.full((1500, 1), 0.9)
    _, current, true = follow(plant_of(arm, start_rad=np.array([0.9])), arm, path)
    x = true[-1, 0] - 0.2
    assert current[-1, 0] * 10 == pytest.approx(40 * x + 30 * x**3, rel=1e-4)


def test_a_hose_stiffens_beyond_its_slack() -> None:
    arm = robot("spring@a:stiffness_Nm_rad=40,progressive_rad=0.5", joint=axis(coulomb_Nm=0.0))
    _, current, true = follow(plant_of(arm, start_rad=np.array([1.0])), arm, np.full((1500, 1), 1.0))
    assert current[-1, 0] * 10 == pytest.approx(40 * true[-1, 0] * np.sqrt(1 + (true[-1, 0] / 0.5) ** 2), rel=1e-4)


def test_an_obstacle_pushes_back_while_it_is_there_and_never_more_than_it_can() -> None:
    effect = "contact@a:start_s=0.5,duration_s=0.4,stiffness_Nm_rad=2000,limit_Nm=12"
    paths = 0.5 * PERIOD_S * np.arange(1, 1501)[:, None]
    free, hit = (follow(plant_of(arm), arm, paths)[1][:, 0] * 10 for arm in (robot(), robot(effect)))
    assert np.abs(hit - free)[:499].max() < 1e-6
    assert (hit - free)[600:890] == pytest.approx(12.0, abs=0.3)
    assert np.abs(hit - free)[1300:].max() < 0.05


def test_an_obstacle_never_pulls() -> None:
    plant = plant_of(
        robot(
            "contact@a:start_s=0.1,duration_s=5,stiffness_Nm_rad=2000,limit_Nm=100",
            joint=axis(coulomb_Nm=0.0, viscous_Nms_rad=0.0),
        )
    )
    push(plant, np.full(100, 0.5))
    coming = plant.qd[0]
    push(plant, np.zeros(400))
    assert plant.qd[0] == pytest.approx(-coming, rel=1e-3)  # elastic: thrown back, then free


def test_a_periodic_torque_shakes_at_its_frequency() -> None:
    arm = robot(
        "disturbance.periodic@a:amplitude_Nm=2,frequency_Hz=13,phase_rad=1.5707963",
        joint=axis(coulomb_Nm=0.0, viscous_Nms_rad=0.0),
    )
    q = push(plant_of(arm), np.zeros(1000))[:, 0]
    w, t = 2 * np.pi * 13, PERIOD_S * np.arange(1, 1001)
    assert q == pytest.approx(2 / (INERTIA * w**2) * (1 - np.cos(w * t)), abs=2e-6)
