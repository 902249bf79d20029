"""The simulated arm: integration, friction, brakes, current loops, sensors."""

from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from emulator import kernels
from emulator.plant import BRAKE_FACTOR, Plant
from protocols.errors import ConfigError
from protocols.robot import Control, Drive, Joint, Parameters, Robot, geometry, load

Floats = NDArray[np.float64]

PERIOD_S = 1e-3
CST, CSP, OFF = 10, 8, 0
# 1 A is 10 N·m at once: a loop so fast and a winding so resistive that back-EMF and supply do not matter.
IDEAL = Drive(
    gear_ratio=100.0,
    drive_gain_Nm_A=10.0,
    rated_current_A=2.0,
    max_current_A=8.0,
    current_bandwidth_Hz=1e6,
    resistance_Ohm=100.0,
    inductance_H=0.2,
    bus_voltage_V=1e9,
)


def axis(name: str, drive: Drive = IDEAL, **keys: Any) -> Joint:
    """A link of 3 kg, 0.2 m from its axis."""
    parameters = {
        "mass_kg": 3.0,
        "first_moment_kgm": (0.6, 0.0, 0.0),
        "inertia_kgm2": (0.01, 0.0, 0.0, 0.13, 0.0, 0.13),
        "rotor_inertia_kgm2": 0.1,
    } | keys.pop("parameters", {})
    return Joint(
        name=name,
        position_min_rad=-10.0,
        position_max_rad=10.0,
        velocity_max_rad_s=10.0,
        torque_max_Nm=50.0,
        drive=drive,
        parameters=Parameters(**parameters),
        **keys,
    )


def double_pendulum(**parameters: Any) -> Robot:
    """Two horizontal axes: gravity and all couplings act. Drives as good as disconnected: back-EMF brakes nothing."""
    idle = msgspec.structs.replace(IDEAL, drive_gain_Nm_A=1e-6)
    return Robot(
        name="pendulum",
        joint=[
            axis("upper", idle, alpha_rad=np.pi / 2, parameters=parameters),
            axis("lower", idle, d_m=0.3, parameters=parameters),
        ],
    )


def quiet(robot: Robot, **keys: Any) -> Plant:
    J = robot.joints
    return Plant(robot, PERIOD_S, np.random.default_rng(1), np.zeros(J), np.zeros(J), **keys)


def run(plant: Plant, periods: int, current_A: Any = 0.0, mode: int = CST) -> None:
    J = len(plant.q)
    for _ in range(periods):
        plant.advance(np.full(J, mode), np.zeros(J), np.broadcast_to(np.asarray(current_A, dtype=float), J).copy())


# --- motion ---


def energy(robot: Robot, plant: Plant) -> float:
    chain = geometry(robot)
    link = np.array([joint.parameters.inertial() for joint in robot.joint])
    M = kernels.mass_matrix(chain.R0, chain.p0, chain.prismatic, link, plant.q)
    M += np.diag([joint.parameters.rotor_inertia_kgm2 for joint in robot.joint])
    place, at = np.eye(3), np.zeros(3)
    potential = 0.0
    for j, q in enumerate(plant.q):
        at = at + place @ chain.p0[j]
        c, s = np.cos(q), np.sin(q)
        place = place @ chain.R0[j] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        m, mc = link[j, 0], link[j, 1:4]
        potential -= chain.gravity @ (m * at + place @ mc)
    return float(plant.qd @ M @ plant.qd / 2 + potential)


def test_a_frictionless_arm_that_swings_keeps_its_energy() -> None:
    robot = double_pendulum()
    plant = quiet(robot, start_rad=np.array([0.0, 0.5]))
    start = energy(robot, plant)
    drift = 0.0
    for _ in range(50):
        run(plant, 100)
        drift = max(drift, abs(energy(robot, plant) - start))
    exchanged = 2 * (3.0 * 9.81 * 0.7)  # J, from horizontal to hanging
    assert np.abs(plant.qd).max() > 1.0
    assert drift < 2e-5 * exchanged


def test_error_falls_with_the_square_of_the_step() -> None:
    robot = double_pendulum(viscous_Nms_rad=0.5, motor_viscous_Nms_rad=0.3)
    chain = geometry(robot)
    link = np.array([joint.parameters.inertial() for joint in robot.joint])

    def derivative(_t: float, x: Floats) -> Floats:
        q, qd = x[:2], x[2:]
        M = kernels.mass_matrix(chain.R0, chain.p0, chain.prismatic, link, q) + 0.1 * np.eye(2)
        N = kernels.bias(chain.R0, chain.p0, chain.prismatic, chain.gravity, link, q, qd)
        return np.concatenate([qd, np.linalg.solve(M, -N - 0.8 * qd)])

    start = np.array([0.3, -0.4])
    exact = solve_ivp(derivative, (0, 1.0), np.r_[start, 0, 0], method="DOP853", rtol=1e-12, atol=1e-12).y[:2, -1]
    errors = []
    for substep_Hz in (1000.0, 2000.0, 4000.0):
        plant = quiet(robot, start_rad=start, substep_Hz=substep_Hz)
        run(plant, 1000)
        errors.append(np.abs(plant.q - exact).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[0] < 1e-4
    assert orders == pytest.approx(2.0, abs=0.2)


def test_constant_current_accelerates_the_rotor_and_the_link() -> None:
    robot = Robot(name="one", joint=[axis("a")])  # vertical axis: no gravity
    plant = quiet(robot)
    run(plant, 100, 1.0)
    assert plant.qd[0] == pytest.approx(10.0 / 0.23 * 0.1, rel=1e-3)


def test_a_prismatic_axis_moves_along_itself() -> None:
    robot = Robot(name="slide", joint=[axis("z", kind="prismatic", parameters={"rotor_inertia_kgm2": 1.0})])
    plant = quiet(robot)
    run(plant, 100, 1.0)
    assert plant.qd[0] == pytest.approx((10.0 - 3.0 * 9.81) / 4.0 * 0.1, rel=1e-3)


# --- dry friction ---


@pytest.mark.parametrize(("current_A", "moves"), [(0.49, False), (-0.49, False), (0.51, True), (-0.51, True)])
def test_a_joint_sticks_below_its_coulomb_friction_and_slides_above(current_A: float, moves: bool) -> None:
    robot = Robot(name="one", joint=[axis("a", parameters={"coulomb_Nm": 3.0, "motor_coulomb_Nm": 2.0})])
    plant = quiet(robot)
    run(plant, 1000, current_A)
    if moves:
        assert plant.qd[0] == pytest.approx(np.sign(current_A) * 0.1 / 0.23, rel=0.02)
    else:
        assert abs(plant.q[0]) < 1e-10
        assert abs(plant.qd[0]) < 1e-10


def test_a_sliding_joint_stops_and_stays() -> None:
    robot = Robot(name="one", joint=[axis("a", parameters={"coulomb_Nm": 5.0})])
    plant = quiet(robot)
    run(plant, 100, 1.0)
    speed, before = plant.qd[0], plant.q[0]
    run(plant, 500)
    rest = plant.q[0]
    assert rest - before == pytest.approx(speed**2 / 2 / (5.0 / 0.23), rel=0.02)
    run(plant, 1000)
    assert plant.q[0] == pytest.approx(rest, abs=1e-10)


def test_all_axes_of_the_tx40_hold_still_within_their_friction() -> None:
    robot = load("tx40")
    plant = quiet(robot)  # upright: gravity is within the friction
    run(plant, 500)
    assert np.abs(plant.q).max() < 1e-9


def test_brake_holds_the_arm_that_would_fall_without() -> None:
    robot = load("tx40")
    start = np.array([0.0, 1.2, 0.5, 0.0, 0.5, 0.0])
    free = quiet(robot, start_rad=start)
    run(free, 300)
    assert np.abs(free.q - start).max() > 0.3
    held = quiet(robot, start_rad=start)
    run(held, 300, mode=OFF)
    assert np.abs(held.q - start).max() < 1e-9
    assert held.measure()[2] == pytest.approx(0.0)


def test_brake_stops_a_moving_axis_with_its_own_torque() -> None:
    plant = quiet(Robot(name="one", joint=[axis("a")]))
    run(plant, 100, 1.0)
    speed, before = plant.qd[0], plant.q[0]
    run(plant, 200, 1.0, mode=OFF)
    assert plant.q[0] - before == pytest.approx(speed**2 / 2 / (BRAKE_FACTOR * 50.0 / 0.23), rel=0.02)
    assert abs(plant.qd[0]) < 1e-10


# --- coupling ---


def coupled(**parameters: float) -> Robot:
    """Motor b turns with both joints, as motor 6 of the TX40; joint frames coincide, so links do not couple."""
    massless = {"mass_kg": 0.0, "first_moment_kgm": (0.0, 0.0, 0.0), "inertia_kgm2": (0.0,) * 6}
    return Robot(
        name="wrist",
        coupling=[[1.0, 0.0], [1.0, 1.0]],
        joint=[axis("a", parameters=massless), axis("b", parameters=massless | parameters)],
    )


def test_torque_of_a_coupled_motor_acts_on_both_joints_and_moves_only_its_own() -> None:
    plant = quiet(coupled())
    run(plant, 100, [0.0, 0.1])
    # tau = C' (0, 1) N·m = (1, 1); M = C' diag(0.1) C; hence qdd = (0, 10): motor a stays.
    assert plant.qd == pytest.approx([0.0, 1.0], abs=2e-3)


def test_friction_of_a_coupled_motor_sees_its_own_speed() -> None:
    plant = quiet(coupled(motor_coulomb_Nm=0.5))
    run(plant, 100, [0.1, 0.0])
    # Motor b is held by its friction, so joint b turns back as joint a turns: motor speeds (10 t, 0).
    assert plant.qd == pytest.approx([1.0, -1.0], abs=2e-3)


# --- drives ---


def axis_on_blocks(**keys: Any) -> Robot:
    """A real winding on a rotor too heavy to move."""
    drive = msgspec.structs.replace(
        IDEAL, resistance_Ohm=8.0, inductance_H=0.02, current_bandwidth_Hz=600.0, bus_voltage_V=320.0, **keys
    )
    return Robot(name="blocked", joint=[axis("a", drive, parameters={"rotor_inertia_kgm2": 1e9})])


def test_current_loop_has_its_bandwidth() -> None:
    h = 1e-5
    period = Plant(axis_on_blocks(), h, np.random.default_rng(1), np.zeros(1), np.zeros(1), substep_Hz=1 / h)
    gains = []
    for frequency in (60.0, 600.0):
        t = np.arange(round(0.05 / h)) * h
        response = []
        for target in np.sin(2 * np.pi * frequency * t):
            period.advance(np.array([CST]), np.zeros(1), np.array([target]))
            response.append(period.measure()[2][0])
        tail = slice(len(t) // 2, None)
        wave = np.exp(-2j * np.pi * frequency * t[tail])
        gains.append(2 * abs(np.mean(np.array(response)[tail] * wave)))
    assert gains[0] == pytest.approx(1 / np.sqrt(1 + 0.1**2), rel=2e-3)
    assert gains[1] == pytest.approx(np.sqrt(0.5), rel=5e-3)  # -3 dB


def test_gains_can_be_set_and_must_be_positive() -> None:
    plant = quiet(axis_on_blocks())
    assert plant.current_gains[0] == pytest.approx([2 * np.pi * 600 * 0.02, 0.02 / 8.0])
    run(plant, 1, 1.0)
    brisk = plant.measure()[2][0]
    slow = quiet(axis_on_blocks())
    slow.set_current_gains(0, 5.0, 0.01)
    run(slow, 1, 1.0)
    assert slow.measure()[2][0] < 0.5 * brisk
    with pytest.raises(ConfigError, match=r"a: current loop gains KR = 0 V/A and TN = 0.01 s must be above 0."):
        slow.set_current_gains(0, 0.0, 0.01)


def test_current_stays_within_the_drives_maximum() -> None:
    plant = quiet(axis_on_blocks(max_current_A=3.0))
    run(plant, 50, 100.0)
    assert plant.measure()[2][0] == pytest.approx(3.0)


def test_supply_limits_the_slope_and_the_integrator_does_not_wind_up() -> None:
    plant = quiet(axis_on_blocks())
    plant.advance(np.array([CST]), np.zeros(1), np.array([8.0]))
    t = np.linspace(0, PERIOD_S, 1001)
    fastest = 320 / 8.0 * (1 - np.exp(-t * 8.0 / 0.02))  # A, all voltage on the winding
    assert plant.measure()[2][0] <= np.minimum(fastest, 8.0).mean() * 1.001
    worst = 0.0
    for _ in range(30):
        run(plant, 1, 8.0)
        worst = max(worst, plant.measure()[2][0])
    assert worst < 8.0 * 1.02
    assert plant.measure()[2][0] == pytest.approx(8.0, rel=1e-3)


def test_back_emf_ends_the_acceleration() -> None:
    drive = msgspec.structs.replace(
        IDEAL, current_bandwidth_Hz=600.0, bus_voltage_V=48.0, resistance_Ohm=1.0, inductance_H=0.002
    )
    plant = quiet(Robot(name="one", joint=[axis("a", drive, parameters={"viscous_Nms_rad": 0.1})]))
    run(plant, 5000, 2.0)
    # At rest of speed: 48 V = R i + ke w with i = friction / gain; ke on the joint side is 10 V·s/rad.
    assert plant.qd[0] == pytest.approx(48.0 / (10.0 + 0.1 / 10.0), rel=1e-3)


def test_sign_of_the_gear_turns_torque_encoder_and_back_emf() -> None:
    reversed_drive = msgspec.structs.replace(IDEAL, gear_ratio=-100.0)
    plant, mirrored = (
        quiet(Robot(name="p", joint=[axis("a")])),
        quiet(Robot(name="m", joint=[axis("a", reversed_drive)])),
    )
    run(plant, 200, 0.5)
    run(mirrored, 200, 0.5)
    assert mirrored.q == pytest.approx(-plant.q)
    assert mirrored.measure()[0] == pytest.approx(plant.measure()[0], abs=1)
    run(mirrored, 1, 0.5)
    assert mirrored.measure()[1][0] > 0


def follower() -> Robot:
    control = Control(natural_frequency_rad_s=100.0, inertia_kgm2=0.23)
    return Robot(name="one", joint=[axis("a", control=control)])


def test_csp_follows_a_ramp_with_the_lag_of_its_law() -> None:
    robot = follower()
    plant = quiet(robot)
    speed = 0.8
    for n in range(1, 1001):
        target = robot.motor_counts(np.array([speed * n * PERIOD_S]))
        plant.advance(np.array([CSP]), target, np.zeros(1))
    assert plant.qd[0] == pytest.approx(speed, rel=1e-6)  # targets are interpolated: no ripple
    assert speed * 1.0 - plant.q[0] == pytest.approx(speed / 50.0, rel=1e-3)  # dq / kp, kp = w / (2 z)


def test_csp_starts_from_its_first_target_and_ends_there() -> None:
    robot = follower()
    plant = quiet(robot)
    target = robot.motor_counts(np.array([0.2]))
    for _ in range(500):
        plant.advance(np.array([CSP]), target, np.zeros(1))
    assert plant.q[0] == pytest.approx(0.2, abs=1e-5)


def test_an_axis_without_a_control_law_makes_no_torque_in_csp() -> None:
    plant = quiet(Robot(name="one", joint=[axis("a")]))
    plant.advance(np.array([CSP]), np.array([1e6]), np.zeros(1))
    assert plant.qd[0] == 0.0


# --- sensors, heat, chance ---


def test_reported_current_differs_from_the_true_one_by_the_stated_noise() -> None:
    robot = axis_on_blocks()
    noise_A = 0.05
    plant = Plant(robot, PERIOD_S, np.random.default_rng(3), np.array([noise_A]), np.zeros(1))
    errors = []
    for _ in range(4000):
        before = plant.qd[0]
        run(plant, 1, 1.0)
        true_A = (plant.qd[0] - before) / PERIOD_S * 1e9 / 10.0
        errors.append(plant.measure()[2][0] - true_A)
    assert np.std(errors) == pytest.approx(noise_A, rel=0.05)
    assert abs(np.mean(errors)) < 4 * noise_A / np.sqrt(4000)


def test_encoder_reports_counts_with_the_stated_noise() -> None:
    robot = Robot(name="one", joint=[axis("a")])
    per_rad = robot.counts_per_rad()[0]
    noise_rad = 20 / per_rad
    plant = Plant(robot, PERIOD_S, np.random.default_rng(4), np.zeros(1), np.array([noise_rad]), start_rad=np.ones(1))
    counts, velocities = [], []
    for _ in range(2000):
        run(plant, 1, mode=OFF)
        counts.append(plant.measure()[0][0])
        velocities.append(plant.measure()[1][0])
    assert plant.measure()[0].dtype == np.int64
    assert np.mean(counts) == pytest.approx(per_rad, abs=2)
    assert np.std(counts) == pytest.approx(20, rel=0.06)
    assert velocities[1:] == [round(d / PERIOD_S) for d in np.diff(counts)]


def test_without_noise_the_encoder_is_the_rounded_position() -> None:
    robot = load("tx40")
    start = np.array([0.3, -0.4, 0.5, -0.6, 0.7, -0.8])
    plant = quiet(robot, start_rad=start)
    assert plant.measure()[0] == pytest.approx(robot.motor_counts(start), abs=0.5)
    assert robot.joint_position(plant.measure()[0]) == pytest.approx(start, abs=2e-6)


def test_a_winding_warms_to_its_rated_rise_and_cools_to_ambient() -> None:
    plant = Plant(axis_on_blocks(), 1.0, np.random.default_rng(1), np.zeros(1), np.zeros(1), substep_Hz=20.0)
    run(plant, 5000, 2.0)
    assert plant.motor_temperature_C[0] == pytest.approx(plant.ambient_C + 70.0, abs=2.0)
    run(plant, 10000, mode=OFF)
    assert plant.motor_temperature_C[0] == pytest.approx(plant.ambient_C, abs=0.1)


def test_same_seed_same_run_and_another_seed_another() -> None:
    robot = load("tx40")

    def counts(seed: int) -> list[int]:
        plant = Plant(robot, PERIOD_S, np.random.default_rng(seed), np.full(6, 0.1), np.full(6, 1e-5))
        run(plant, 50, 0.6)
        return [int(c) for c in plant.measure()[0]]

    assert counts(1) == counts(1)
    assert counts(1) != counts(2)


def test_an_arm_that_cannot_be_is_refused_with_a_sentence() -> None:
    robot = Robot(name="ghost", joint=[axis("a", parameters={"inertia_kgm2": (0.0,) * 6, "rotor_inertia_kgm2": -0.1})])
    with pytest.raises(ConfigError, match=r"ghost: the mass matrix is not positive definite at q = \[0.\] rad. Use"):
        run(quiet(robot), 1)
