"""One suite for every estimator: pure, deterministic, indifferent to order and units, and right where truth is known.

Three axes of the TX40 in closed loop, simulated from parameters off the robot file's by a tenth.
"""

from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from ident import auxiliary
from ident.base import base_parameters
from ident.dataset import Command, Signals, prepare
from ident.ekf import ExtendedKalman
from ident.estimate import Estimate
from ident.methods import METHODS
from ident.model import Model
from ident.observation import observe
from ident.problem import Estimator, Problem
from protocols.errors import ArmrigError, DataError
from protocols.robot import Robot, load

PERIOD_S, DURATION_S = 0.001, 4.0
NOISE_NM, NOISE_RAD = np.array([0.3, 0.3, 0.15]), 1e-6
NEAR = {"ekf": 0.02, "setmembership": 0.05}  # relative distance to the truth; the others: by their own intervals
SIMULATING = {"iv", "cloe", "didim"}  # refit to scaled torques means other gains, not only other units


def robot() -> Robot:
    tx40 = load("tx40")
    stiff = [  # current loops that never give way: what was commanded is what was measured
        msgspec.structs.replace(j, drive=msgspec.structs.replace(j.drive, current_bandwidth_Hz=1e9))
        for j in tx40.joint[:3]
    ]
    return msgspec.structs.replace(tx40, name="three axes", joint=stiff, coupling=None)


def truth(model: Model) -> np.ndarray:
    return model.theta(model.robot) * (1 + 0.1 * np.sin(np.arange(len(model.names))))


def recording(model: Model, seed: int) -> Signals:
    """Closed-loop run on a multisine that starts at rest."""
    rng = np.random.default_rng(seed)
    J = model.joints
    t = np.arange(round(DURATION_S / PERIOD_S)) * PERIOD_S
    frequency, phase = rng.uniform(0.3, 1.3, (4, J)), rng.uniform(0, 2 * np.pi, (4, J))
    wave = (0.3 * np.sin(2 * np.pi * frequency * t[:, None, None] + phase)).sum(axis=1)
    rise = np.clip(t / 0.5, 0, 1)[:, None]
    reference = rise**3 * (10 - 15 * rise + 6 * rise**2) * wave
    joints = model.robot.joint_names
    blank = Signals(f"run {seed}", joints, t, np.zeros((t.size, J)), np.zeros((t.size, J)), np.full(J, PERIOD_S / 2))
    run = auxiliary.runs([replace(blank, command=lambda: Command(reference))])[0]
    (simulations,) = auxiliary.simulate([run], model, truth(model), update_gains=False)
    clean = auxiliary.as_signals(run, simulations)
    q = clean.q + NOISE_RAD * rng.normal(size=clean.q.shape)
    return replace(clean, q=q, tau_Nm=clean.tau_Nm + NOISE_NM * rng.normal(size=clean.q.shape))


def problem_of(recordings: list[Signals], model: Model) -> Problem:
    base = base_parameters(model)
    datasets = [prepare(s) for s in recordings]
    rows = [observe(d, model, base) for d in datasets]
    return Problem(model, base, recordings, datasets, rows, 50.0, None)


@pytest.fixture(scope="module")
def problem() -> Problem:
    model = Model.of(robot())
    return problem_of([recording(model, seed) for seed in (1, 2)], model)


@pytest.fixture(scope="module")
def fit(problem: Problem) -> Callable[[str], Estimate]:
    """Each method's estimate, made once."""
    made: dict[str, Estimate] = {}

    def of(key: str) -> Estimate:
        if key not in made:
            made[key] = method(key).fit(problem)
        return made[key]

    return of


@pytest.fixture(params=list(METHODS))
def key(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def method(key: str) -> Estimator:
    return ExtendedKalman(rate_Hz=250.0) if key == "ekf" else METHODS[key]


def test_truth_comes_back(key: str, problem: Problem, fit: Callable[[str], Estimate]) -> None:
    expected = problem.base.B @ truth(problem.model)
    found = fit(key)
    assert np.linalg.norm(found.beta - expected) < NEAR.get(key, 0.02) * np.linalg.norm(expected)
    if key not in NEAR:
        z = (found.beta - expected) / found.std
        assert np.sqrt(np.mean(z**2)) < 1.8, dict(zip(problem.base.names, z.round(1), strict=True))


def test_a_fit_is_pure(key: str, problem: Problem, fit: Callable[[str], Estimate]) -> None:
    def contents() -> list[bytes]:
        arrays = [a for s in problem.signals for a in (s.t_s, s.q, s.tau_Nm)]
        arrays += [a for d in problem.datasets for g in d.segments for a in (g.q, g.qd, g.qdd, g.tau_Nm)]
        arrays += [a for o in problem.observations for a in (o.W, o.y, o.used)]
        return [a.tobytes() for a in arrays]

    before = contents()
    again = method(key).fit(problem)
    assert contents() == before
    np.testing.assert_array_equal(again.beta, fit(key).beta)
    np.testing.assert_array_equal(again.covariance, fit(key).covariance)
    assert again.notes == fit(key).notes


def test_the_result_is_whole(key: str, problem: Problem, fit: Callable[[str], Estimate]) -> None:
    found = fit(key)
    b = len(problem.base.names)
    assert found.beta.shape == found.std.shape == (b,)
    assert found.covariance.shape == found.white.shape == (b, b)
    np.testing.assert_allclose(found.covariance, found.covariance.T, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.std**2, np.diag(found.covariance))
    assert (found.std > 0).all()
    assert np.isfinite(found.beta).all()
    assert found.converged
    assert found.iterations >= 1
    assert found.covariance_name
    assert str(found).startswith(f"{method(key).name}: {b} base parameters, ")
    with pytest.raises(AttributeError):
        found.method = "other"  # type: ignore[misc]


def test_the_order_of_recordings_does_not_matter(key: str, problem: Problem, fit: Callable[[str], Estimate]) -> None:
    """To a filter that passes once it does, but by less than its own error."""
    turned = replace(
        problem,
        signals=problem.signals[::-1],
        datasets=problem.datasets[::-1],
        observations=problem.observations[::-1],
    )
    other, found = method(key).fit(turned), fit(key)
    allowed = NEAR["ekf"] * np.abs(found.beta).max() if key == "ekf" else 1e-4 * found.std
    assert (np.abs(other.beta - found.beta) <= allowed).all()


def test_torques_in_other_units_give_parameters_in_those(
    key: str, problem: Problem, fit: Callable[[str], Estimate]
) -> None:
    if key in SIMULATING or key == "ekf":
        pytest.skip("the control law and the a-priori parameters are in N·m")
    unit = 1000.0
    scaled = replace(
        problem,
        signals=[replace(s, tau_Nm=unit * s.tau_Nm) for s in problem.signals],
        datasets=[
            replace(d, segments=[replace(g, tau_Nm=unit * g.tau_Nm) for g in d.segments]) for d in problem.datasets
        ],
        observations=[replace(o, y=unit * o.y) for o in problem.observations],
    )
    other, found = method(key).fit(scaled), fit(key)
    assert (np.abs(other.beta / unit - found.beta) <= 1e-3 * found.std).all()
    np.testing.assert_allclose(other.std / unit, found.std, rtol=1e-3)


@pytest.mark.parametrize("where", ["W", "y"])
def test_rows_that_are_no_numbers_are_refused(key: str, where: str, problem: Problem) -> None:
    first = problem.observations[0]
    broken = getattr(first, where).copy()
    broken[1, 7] = np.nan
    every = np.ones_like(first.used)
    with pytest.raises(DataError, match=r"run 1: the row of joint2 at \d.\d+ s is not a number. Cut that part out"):
        method(key).fit(replace(problem, observations=[replace(first, used=every, **{where: broken})]))


def test_a_motion_that_does_not_show_everything_is_refused(key: str) -> None:
    if key in {"cloe", "didim"}:
        pytest.skip("positions measured do not enter their columns; simulated ones move")
    model = Model.of(robot())
    run = recording(model, 3)
    q = run.q.copy()
    q[:, 2] = 0.3
    with pytest.raises(ArmrigError) as error:
        method(key).fit(problem_of([replace(run, q=q)], model))
    assert "This motion does not show" in str(error.value)
    assert "Fv3" in str(error.value)
    assert "joint3 moved by only" in str(error.value)


def test_two_recordings_tell_more_than_one(key: str, problem: Problem, fit: Callable[[str], Estimate]) -> None:
    alone = method(key).fit(
        replace(
            problem, signals=problem.signals[:1], datasets=problem.datasets[:1], observations=problem.observations[:1]
        )
    )
    assert np.median(fit(key).std / alone.std) < 1.0
