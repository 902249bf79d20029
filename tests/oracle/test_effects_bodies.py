"""Effects that change bodies and what carries them, and the energy of everything together."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator import kernels
from emulator.effects.period import Memory, Physics
from emulator.effects.unlisted import Form
from emulator.plant import Plant
from protocols.effectentries import parse_effect
from protocols.errors import ConfigError
from protocols.robot import Drive, EffectEntry, Joint, Parameters, Robot, load

Floats = NDArray[np.float64]

PERIOD_S = 1e-3
CST, OFF = 10, 0
G = 9.81
# 1 A is 10 N·m at once; with as good as no gain it is a drive that is not there.
DRIVE: dict[str, Any] = {
    "gear_ratio": 10.0,
    "drive_gain_Nm_A": 10.0,
    "rated_current_A": 5.0,
    "max_current_A": 50.0,
    "current_bandwidth_Hz": 1e6,
    "resistance_Ohm": 100.0,
    "inductance_H": 0.2,
    "bus_voltage_V": 1e9,
}
DISC = {"inertia_kgm2": (0.0, 0.0, 0.0, 0.0, 0.0, 0.4), "rotor_inertia_kgm2": 0.1}
SLED = {"mass_kg": 4.0, "rotor_inertia_kgm2": 0.1}


def axis(
    name: str = "a", kind: Any = "revolute", *, gain: float = 10.0, alpha: float = 0.0, d: float = 0.0, **body: Any
) -> Joint:
    return Joint(
        name=name,
        kind=kind,
        alpha_rad=alpha,
        d_m=d,
        position_min_rad=-10.0,
        position_max_rad=10.0,
        velocity_max_rad_s=5.0,
        torque_max_Nm=200.0,
        drive=Drive(**DRIVE | {"drive_gain_Nm_A": gain}),
        parameters=Parameters(**body),
    )


def robot(*effects: str, joints: list[Joint]) -> Robot:
    return Robot(name="test", joint=joints, effect=[parse_effect(text) for text in effects])


def plant_of(arm: Robot, **keys: Any) -> Plant:
    J = arm.joints
    return Plant(arm, PERIOD_S, np.random.default_rng(1), np.zeros(J), np.zeros(J), **keys)


def run(plant: Plant, periods: int, current: float = 0.0, mode: int = CST) -> None:
    J = len(plant.q)
    for _ in range(periods):
        plant.advance(np.full(J, mode), np.zeros(J), np.full(J, current))


def inside(plant: Plant) -> tuple[Physics, Memory]:
    extended = plant._extended
    assert extended is not None
    return extended


# --- bodies ---


def test_payload_weighs_and_resists_by_steiner() -> None:
    """On a horizontal axis: m g x, and J + I + m x²."""
    plant = plant_of(robot("payload:mass_kg=2,x_m=0.3,inertia_kgm2=0.05", joints=[axis(alpha=np.pi / 2, **DISC)]))
    run(plant, 20)
    assert plant.qd[0] == pytest.approx(-2 * G * 0.3 / (0.55 + 2 * 0.09) * 0.02, rel=1e-3)


def test_payload_is_a_body_like_any_other() -> None:
    """Its ten parameters against those of a link made of it alone, in every direction (Steiner with products)."""
    bare = robot(joints=[axis("a", alpha=0.4), axis("b", alpha=1.0, d=0.3, **DISC)])
    load_ = "payload:mass_kg=2,x_m=0.1,y_m=-0.2,z_m=0.3,inertia_kgm2=0.02"
    c, m = np.array([0.1, -0.2, 0.3]), 2.0
    corners = [np.array(v) for v in np.ndindex(2, 2, 2)]
    spread = np.sqrt(0.02 / m / 2)  # eight points of m/8 at c ± spread have the moment 2 m spread² about each axis
    points = [c + spread * (2 * v - 1) for v in corners]
    inertia = sum(m / 8 * (p @ p * np.eye(3) - np.outer(p, p)) for p in points)
    loaded = plant_of(robot(load_, joints=bare.joint))._body.link[1] - plant_of(bare)._body.link[1]
    assert loaded == pytest.approx([m, *(m * c), *np.asarray(inertia)[np.triu_indices(3)]], abs=1e-12)


def test_tilt_lets_gravity_act_on_a_level_slide() -> None:
    level = axis(kind="prismatic", alpha=-np.pi / 2, **SLED)  # moves along y
    plant = plant_of(robot("base.tilt:x_rad=0.05", joints=[level]))
    run(plant, 100)
    assert plant.qd[0] == pytest.approx(-4 * G * np.sin(0.05) / 4.1 * 0.1, rel=2e-3)
    upright = plant_of(robot("base.tilt:x_rad=0,y_rad=0.05", joints=[level]))
    run(upright, 100)
    assert abs(upright.qd[0]) < 1e-9


def test_a_soft_base_swings_at_its_frequency_with_the_whole_machine() -> None:
    arm = robot(
        "base.flexibility:frequency_Hz=9,damping=0.02,inertia_kgm2=20",
        joints=[axis(kind="prismatic", alpha=np.pi / 2, **SLED)],
    )
    plant = plant_of(arm)
    run(plant, 50, 5.0)
    swing = []
    for _ in range(2200):
        run(plant, 1, mode=OFF)
        swing.append(inside(plant)[1].x[0])
    x = np.array(swing)[200:] * np.hanning(2000)
    peak = np.argmax(np.abs(np.fft.rfft(x, 64_000))) / (64_000 * PERIOD_S)
    assert peak == pytest.approx(9.0 * np.sqrt(1 - 0.02**2), rel=5e-3)
    crests = [np.abs(swing[k : k + 120]).max() for k in (200, 1200)]
    assert np.log(crests[0] / crests[1]) == pytest.approx(0.02 * 2 * np.pi * 9, rel=0.05)


def test_a_soft_base_bends_under_the_arms_weight() -> None:
    link = axis(
        alpha=-np.pi / 2,
        mass_kg=5.0,
        first_moment_kgm=(2.0, 0.0, 0.0),
        inertia_kgm2=(0, 0, 0, 0.8, 0, 0.8),
        rotor_inertia_kgm2=0.1,
    )
    plant = plant_of(robot("base.flexibility:frequency_Hz=20,damping=0.1,inertia_kgm2=5,height_m=0", joints=[link]))
    run(plant, 300, mode=OFF)
    constants, memory = inside(plant)
    assert memory.x[1] == pytest.approx(2.0 * G / constants.base.stiffness[1], rel=0.01)  # the level link, about y
    assert memory.x[0] == pytest.approx(0.0, abs=1e-6)
    assert memory.xd == pytest.approx(0.0, abs=1e-4)  # it started where it rests


def test_the_height_of_the_base_counts() -> None:
    """A pendulum on a stalk: rocking inertia about the pivot grows by m h²."""
    disc = axis(mass_kg=3.0, **DISC)
    low, high = (
        inside(plant_of(robot(f"base.flexibility:frequency_Hz=10,inertia_kgm2=2,height_m={h}", joints=[disc])))[0]
        for h in (0.0, 0.5)
    )
    w2 = (2 * np.pi * 10) ** 2
    assert low.base.stiffness == pytest.approx([2.0 * w2, 2.0 * w2])
    assert high.base.stiffness == pytest.approx([(2.0 + 3 * 0.25) * w2] * 2)


# --- energy ---


def pendulum(*effects: str, **friction: float) -> Robot:
    """Two horizontal axes that swing freely: drives as good as disconnected."""
    body = {
        "mass_kg": 3.0,
        "first_moment_kgm": (0.6, 0.0, 0.0),
        "inertia_kgm2": (0.01, 0.0, 0.0, 0.13, 0.0, 0.13),
        "rotor_inertia_kgm2": 0.1,
    } | friction
    joints = [axis("a", gain=1e-6, alpha=np.pi / 2, **body), axis("b", gain=1e-6, d=0.3, **body)]
    return robot(*effects, joints=joints)


def energy(plant: Plant) -> float:
    """Kinetic energy and potential of gravity and springs of everything that moves [J]."""
    constants, memory = inside(plant)
    chain, shafts, base = constants.chain, constants.shafts, constants.base
    N, B = len(chain.p0), len(base.stiffness)
    A = np.zeros((len(memory.x),) * 2)
    A[:N, :N] = kernels.mass_matrix(chain.R0, chain.p0, chain.prismatic, chain.link, memory.x[:N])
    A[B:N, B:N] += constants.rotor
    A[shafts.rotor, shafts.rotor] += shafts.inertia
    total = memory.xd @ A @ memory.xd / 2 + base.stiffness @ memory.x[:B] ** 2 / 2
    turn, at = np.eye(3), np.zeros(3)
    for j in range(N):
        at = at + turn @ chain.p0[j]
        c, s = np.cos(memory.x[j]), np.sin(memory.x[j])
        turn = turn @ chain.R0[j] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        total -= chain.gravity @ (chain.link[j, 0] * at + turn @ chain.link[j, 1:4])
    twist = shafts.twist @ memory.x
    pressed = np.sign(twist) * np.maximum(np.abs(twist) - shafts.gap / 2, 0)
    total += np.sum(shafts.stiffness * pressed**2 / 2 + shafts.cubic * pressed**4 / 4)
    outside, motors = constants.environment, constants.motors
    x = plant.q[outside.spring] - outside.centre
    p = np.where(outside.progressive > 0, outside.progressive, np.inf)
    with np.errstate(invalid="ignore"):
        hose = np.where(np.isinf(p), x**2 / 2, p**2 / 3 * ((1 + (x / p) ** 2) ** 1.5 - 1))
    total += np.sum(outside.stiffness * hose + outside.cubic * x**4 / 4)
    angle = plant.q.copy()  # of the motors: those behind a shaft have their own
    angle[shafts.motor] = memory.x[shafts.rotor]
    cog = motors.amplitude / motors.per_rad * np.cos(motors.per_rad * angle[motors.motor] + motors.phase)
    return float(total + cog.sum())


CONSERVATIVE = [
    "transmission.elasticity@a:stiffness_Nm_rad=800,damping_Nms_rad=0",
    "transmission.elasticity@b:stiffness_Nm_rad=300,damping_Nms_rad=0,cubic_Nm_rad3=1e4",
    "transmission.backlash@b:gap_rad=0.01,stiffness_Nm_rad=2000,damping_Nms_rad=0",
    "motor.ripple@a:amplitude_Nm=1,order=2",
    "spring@b:stiffness_Nm_rad=5,cubic_Nm_rad3=2",
    "spring@a:stiffness_Nm_rad=5,progressive_rad=0.3",
    "base.flexibility:frequency_Hz=15,damping=0,inertia_kgm2=4",
    "payload:mass_kg=0.5,x_m=0.1",
]


@pytest.mark.parametrize(
    "effects",
    [[e] for e in CONSERVATIVE[:-1]] + [[CONSERVATIVE[k] for k in (0, 1, 3, 4, 6, 7)]],
    ids=lambda e: "+".join(t.partition(":")[0] for t in e),
)
def test_what_only_stores_energy_loses_none(effects: list[str]) -> None:
    plant = plant_of(pendulum(*effects), start_rad=np.array([0.3, 0.5]))
    start, drift = energy(plant), 0.0
    for _ in range(60):
        run(plant, 50)
        drift = max(drift, abs(energy(plant) - start))
    assert np.abs(plant.qd).max() > 0.5
    assert drift < 2e-3 * 40.0  # J, of what is exchanged on the way down


DISSIPATIVE = [
    "friction.stribeck@a:stiction_Nm=0.5,velocity_rad_s=0.1",
    "friction.asymmetric@b:half_difference_Nm=0.2",
    "friction.viscous_nonlinear@a:torque_Nm=0.5,velocity_rad_s=1,exponent=0.5",
    "friction.load@b:coefficient=0.2",
    "friction.presliding@a:distance_rad=0.01",
    "friction.presliding@b:distance_rad=0.001,damping_Nms_rad=0.1",
    "friction.position@b:amplitude_Nm=0.5,centre_rad=-1,width_rad=0.3",
    "transmission.efficiency@b:driving=0.8,braking=0.7",
    "transmission.elasticity@a:stiffness_Nm_rad=800,damping_Nms_rad=1",
    "transmission.backlash@b:gap_rad=0.01,stiffness_Nm_rad=2000,damping_Nms_rad=3",
    "transmission.coupling@b:viscous_Nms_rad=0.05,coulomb_Nm=0.2",
    "base.flexibility:frequency_Hz=15,damping=0.05,inertia_kgm2=4",
]


@pytest.mark.parametrize("effect", DISSIPATIVE, ids=lambda e: e.partition(":")[0])
def test_what_dissipates_never_gives_energy_back(effect: str) -> None:
    """But for what bristles store, which is not in `energy`: Fc times the distance, twice."""
    arm = pendulum(effect, coulomb_Nm=0.4)
    plant = plant_of(arm, start_rad=np.array([0.3, 0.5]))
    stored = 0.02 if "presliding" in effect else 1e-3
    levels = [energy(plant)]
    for _ in range(100):
        run(plant, 40)
        levels.append(energy(plant))
    assert np.diff(levels).max() < stored
    assert levels[-1] < levels[0] - 5.0


def test_everything_at_once_is_stable_and_the_same_from_1_to_8_kilohertz() -> None:
    effects = list({e.partition(":")[0]: e for e in CONSERVATIVE + DISSIPATIVE}.values())
    ends = []
    for substep_Hz in (1000.0, 8000.0):
        plant = plant_of(pendulum(*effects, coulomb_Nm=0.4), start_rad=np.array([0.3, 0.5]), substep_Hz=substep_Hz)
        start = energy(plant)
        for _ in range(60):
            run(plant, 50)
            assert energy(plant) < start + 0.5
        ends.append([*plant.q, *plant.qd])
    assert ends[0] == pytest.approx(ends[1], abs=2e-3)


@pytest.mark.parametrize("form", list(Form))
def test_unlisted_physics_is_passive(form: Form) -> None:
    """What it stores is bounded by what its springs hold: a² and b are small here."""
    b = {Form.FLUID: 0.3, Form.THIXOTROPIC: 0.5, Form.GROOVE: 5.0, Form.CLUTCH: 1.0}.get(form, -1.0)
    entry = EffectEntry(effect="unlisted", joint="b", parameters={"form": float(form), "other": 0.0, "a": 0.3, "b": b})
    arm = pendulum(coulomb_Nm=0.3)
    plant = plant_of(Robot(name="unlisted", joint=arm.joint, effect=[entry]), start_rad=np.array([0.3, 0.5]))
    start = energy(plant)
    for _ in range(60):
        run(plant, 50)
        assert energy(plant) < start + 0.3 * 2 * np.pi**2
    assert energy(plant) < start


# --- beside the plain arm ---


def test_without_strength_the_extended_arm_is_the_plain_one() -> None:
    """The same kernels, noise and all, through both integrators."""
    plain = load("tx40")
    idle = Robot(
        name="idle",
        coupling=plain.coupling,
        joint=plain.joint,
        effect=[parse_effect("spring@joint1:stiffness_Nm_rad=0")],
    )
    found = []
    for arm in (plain, idle):
        plant = Plant(arm, PERIOD_S, np.random.default_rng(3), np.full(6, 0.1), np.full(6, 1e-6))
        targets = arm.motor_counts(0.3 * np.sin(np.outer(PERIOD_S * np.arange(800), 1.0 + np.arange(6))))
        found.append([])
        for target in targets:
            plant.advance(np.full(6, 8), target, np.zeros(6))
            found[-1].append(np.concatenate(plant.measure()))
    assert np.array(found[0]) == pytest.approx(np.array(found[1]), abs=1e-9)


def test_inertia_before_a_spring_is_taken_from_the_link() -> None:
    """A file that gives the whole moving mass to the link, as the EMPS' does."""
    whole = axis(kind="prismatic", mass_kg=95.0)
    effect = "transmission.elasticity@a:stiffness_Nm_rad=1e6,motor_inertia_kgm2={}"
    constants, _ = inside(plant_of(robot(effect.format(20), joints=[whole])))
    assert constants.shafts.inertia[0] == 20.0
    assert constants.chain.link[0, 0] == 75.0
    constants, _ = inside(plant_of(robot(effect.format(0), joints=[whole])))
    assert constants.shafts.inertia[0] == 95 / 4
    with pytest.raises(ConfigError, match=r"elasticity@a: 120 kg·m² before the spring would leave -25 kg·m² behind it"):
        plant_of(robot(effect.format(120), joints=[whole]))
