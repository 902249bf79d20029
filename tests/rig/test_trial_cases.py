"""Cases of the blind trial: drawn, sealed, played through frames and past them.

Seeds are development seeds; nothing here looks at how well anything is explained.
"""

import msgspec
import numpy as np
import pytest

from emulator.host import PdLaw
from emulator.plant import Plant
from emulator.trial import DEVELOPMENT_SEEDS, SCORING_SEEDS, Case, Run, Seal, draw, record, simulate
from emulator.trialeffects import DRAWS, STRENGTH, draw_effect, draw_unlisted, scaled
from emulator.trialmotions import PERIODS, Planned, once
from emulator.trialrun import run
from protocols.effectentries import check_effects
from protocols.effectparams import EFFECT_KINDS
from protocols.errors import ConfigError
from protocols.frames import Frame
from protocols.motion import Motion, Points, sample
from protocols.robot import load
from protocols.topics import CellSample


@pytest.fixture(scope="module")
def case() -> Case:
    return draw(42, "emps", effect="friction.stribeck")


def test_a_seed_gives_the_same_case_and_another_a_different_one(case: Case) -> None:
    again = draw(42, "emps", effect="friction.stribeck")
    assert again.seal == case.seal
    assert again.runs == case.runs
    assert draw(43, "emps", kind="none").seal.sha256 != draw(44, "emps", kind="none").seal.sha256


def test_seeds_for_development_are_not_those_for_scoring() -> None:
    assert not set(DEVELOPMENT_SEEDS) & set(SCORING_SEEDS)
    with pytest.raises(ConfigError, match=r"seed 500000 is in no range: 1 to 99999 are for development, 1000000 to"):
        draw(500_000)


def test_the_truth_opens_and_a_broken_seal_is_told(case: Case) -> None:
    truth = case.seal.open()
    assert truth.kind == "single"
    assert [entry.effect for entry in truth.effects] == ["friction.stribeck"]
    assert truth.machine.effect == truth.effects
    assert len(truth.nonce) == 32
    forged = Seal(case.seal.content.replace(b"stribeck", b"position"), case.seal.sha256)
    with pytest.raises(ConfigError, match=r"the seal is broken: its content has the SHA-256 [0-9a-f]{16}\.\.\., but"):
        forged.open()


def test_the_robot_file_is_wrong_as_it_says_and_tells_nothing(case: Case) -> None:
    truth = case.seal.open()
    assert case.robot.effect == []
    assert case.rig.emulated.effect == []
    assert case.rig.emulated.machine is None
    arm = draw(45, "tx40", kind="none")
    for believed, true in zip(arm.robot.joint, arm.seal.open().machine.joint, strict=True):
        assert believed.sigma is not None
        assert believed.drive == true.drive
        away, sigma = ([], [])
        for name in ("mass_kg", "first_moment_kgm", "inertia_kgm2", "viscous_Nms_rad", "coulomb_Nm"):
            difference = np.array(getattr(believed.parameters, name)) - np.array(getattr(true.parameters, name))
            away += np.atleast_1d(difference).tolist()
            sigma += np.atleast_1d(getattr(believed.sigma, name)).tolist()
        z = np.array(away) / np.array(sigma)
        assert np.abs(z).max() <= 2.001
        assert 0.4 < np.sqrt(np.mean(z**2)) < 1.6
    assert truth.machine.joint[0].parameters != case.robot.joint[0].parameters


def test_strength_is_the_change_of_current_over_its_noise(case: Case) -> None:
    """Measured once more, on another motion of the session."""
    truth = case.seal.open()
    bare = msgspec.structs.replace(truth.machine, effect=[])
    each = [
        run(case.rig, case.robot, machine, case.runs[2].plan, 40.0, seed=5).current_permille
        for machine in (truth.machine, bare)
    ]
    change_A = np.std(each[0] - each[1]) * case.robot.joint[0].drive.rated_current_A / 1000
    strength = change_A / case.rig.emulated.current_noise_A[0]
    assert 0.3 < strength / truth.strength[0] < 3.0
    assert truth.strength[0] >= 0.3
    assert truth.strongest == ["carriage"]


def test_a_session_repeats_its_motions_and_warms_up(case: Case) -> None:
    assert [r.name for r in case.runs] == ["multisine-1", "multisine-2", "slow-reversals", "unseen"]
    assert [r.start_s for r in case.runs] == [0.0, 420.0, 840.0, 1260.0]
    warmth = [r.temperature_C for r in case.runs]
    assert warmth == sorted(warmth)
    assert warmth[-1] - warmth[0] > 5.0
    for r in case.runs:
        reference = sample(r.plan, case.robot, 1e-3)
        period = round(1000 * r.period_s)
        first = 2000 if r.name != "slow-reversals" else 2000 + period  # its first move comes from elsewhere
        repeats = [reference.q[first + k * period : first + (k + 1) * period] for k in range(PERIODS - 1)]
        assert repeats[1] == pytest.approx(repeats[0], abs=1e-9)
    slow = sample(case.runs[2].plan, case.robot, 1e-3)
    reversals = np.count_nonzero(np.diff(np.sign(slow.qd[np.abs(slow.qd[:, 0]) > 1e-6, 0])))
    assert reversals >= 8 * PERIODS - 4


def test_the_short_way_and_the_frames_tell_the_same(case: Case) -> None:
    """The frames' motion starts some cycles later and has other noise; currents differ by no more."""
    motion = case.runs[2]
    segment = motion.plan.segment[0]
    assert isinstance(segment, Points)
    quick = Motion(name="quick", segment=[Points(point_rad=segment.point_rad[:3], move_s=segment.move_s[:2])])
    short = Run(quick.name, quick, motion.period_s, 0.0, 30.0, 7)
    passed: list[tuple[int, Frame]] = []
    cells: list[CellSample] = []
    whole = Case(case.seed, case.rig, case.robot, (short,), case.seal)
    simulated_ns = record(whole, short, lambda _bus, frames: passed.extend(frames), cells.append)
    direct = simulate(whole, short)
    assert simulated_ns >= 1e9 * direct.t_s[-1]
    assert len(cells) == pytest.approx(simulated_ns * 1e-9 * 20, abs=2)
    assert cells[0].motor_temperature_C[0] == pytest.approx(30.0, abs=0.1)
    feedback = [f.data for _, f in passed if f.can_id == 0x181]
    counts = np.array([int.from_bytes(d[:4], "little", signed=True) for d in feedback])
    currents = np.array([int.from_bytes(d[4:6], "little", signed=True) for d in feedback])
    at = [int(np.flatnonzero(np.abs(c - c[0]) > 2000)[0]) for c in (counts, direct.position_counts[:, 0])]
    n = min(len(counts) - at[0], len(direct.t_s) - at[1])
    a, b = (c[k : k + n].astype(float) for c, k in ((counts, at[0]), (direct.position_counts[:, 0], at[1])))
    assert np.abs(a - b).max() < 0.02 * np.ptp(b)
    p, q = currents[at[0] : at[0] + n], direct.current_permille[at[1] : at[1] + n, 0]
    noise = 1000 * case.rig.emulated.current_noise_A[0] / case.robot.joint[0].drive.rated_current_A
    assert np.std(p - q) < 2.0 * np.sqrt(2) * noise


def test_the_compiled_loop_is_the_hosts_law_and_the_plant() -> None:
    case = draw(46, "tx40", kind="none")
    robot, first = case.robot, case.runs[0]
    found = run(case.rig, robot, case.seal.open().machine, first.plan, 25.0, seed=3)
    noise = case.rig.emulated
    plant = Plant(
        case.seal.open().machine,
        1e-3,
        np.random.default_rng(3),
        np.array(noise.current_noise_A),
        np.array(noise.encoder_noise_rad),
    )
    plant.warm_to(np.full(6, 25.0))
    law, target = PdLaw(robot, 1e-3), np.zeros(6)
    per_mille = 1000 / np.array([joint.drive.rated_current_A for joint in robot.joint])
    law.current(np.zeros(6), robot.joint_position(plant.measure()[0]))
    for n in range(1500):
        plant.advance(np.full(6, 10), np.zeros(6), target)
        counts, _, current = plant.measure()
        assert np.array_equal(counts, found.position_counts[n])
        assert np.array_equal(np.rint(current * per_mille), found.current_permille[n])
        wanted = law.current(found.reference[n], robot.joint_position(counts))
        target = np.rint(wanted * per_mille) / per_mille


def test_an_obstacle_appears_in_one_recording_only() -> None:
    case = draw(47, "emps", effect="contact")
    truth = case.seal.open()
    assert 0 <= truth.contact_run < 3
    bare = msgspec.structs.replace(truth.machine, effect=[])
    for k, r in enumerate(case.runs[:2]):
        healthy = run(case.rig, case.robot, bare, r.plan, r.temperature_C, r.seed)
        same = np.array_equal(simulate(case, r).current_permille, healthy.current_permille)
        assert same == (k != truth.contact_run)


@pytest.mark.parametrize("name", ["emps", "tx40"])
def test_every_effect_can_be_drawn_scaled_and_emulated(name: str) -> None:
    robot, rng = load(name), np.random.default_rng(5)
    assert set(DRAWS) == set(EFFECT_KINDS)
    for effect, kind in EFFECT_KINDS.items():
        if robot.joints < kind.least_joints:
            continue
        for _ in range(5):
            entry = draw_effect(effect, robot, rng)
            assert {n for n, _ in STRENGTH.get(effect, ())} <= set(kind.names)
            for factor in (0.1, 1.0, 10.0):
                check_effects([scaled(entry, factor)], robot, "trial")
    for _ in range(10):
        entry = draw_unlisted(robot, rng)
        arm = msgspec.structs.replace(robot, effect=[entry])
        Plant(arm, 1e-3, rng, np.zeros(robot.joints), np.zeros(robot.joints))


def test_one_repetition_is_a_short_motion() -> None:
    case = draw(48, "tx40", kind="none")
    for r in case.runs:
        short = once(Planned(r.plan, r.period_s))
        assert sample(short, case.robot, 0.01).t_s[-1] < r.period_s + 5.0
