"""Estimates against numpy's least squares and the closed forms of the papers."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg

from ident.base import Base, base_parameters
from ident.dataset import Signals, prepare
from ident.estimate import estimate
from ident.model import Model
from ident.observation import Observation, observe
from ident.reduction import reduce
from protocols.errors import IdentificationError
from protocols.robot import Robot

Make = Callable[..., Signals]


@pytest.fixture(scope="module")
def problem(tx40: Robot, make_signals: Make) -> tuple[list[Observation], Base]:
    model = Model.of(tx40)
    base = base_parameters(model)
    return [observe(prepare(make_signals(tx40, s, 8.0, noise_Nm=0.5)), model, base) for s in (1, 2)], base


def stacked(observations: list[Observation], weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    joints = range(len(weights))
    W = np.vstack([o.W[j, o.used[j]] / weights[j] for o in observations for j in joints])
    y = np.concatenate([o.y[j, o.used[j]] / weights[j] for o in observations for j in joints])
    return W, y


def test_ols_is_least_squares(problem: tuple[list[Observation], Base]) -> None:
    observations, base = problem
    fitted = estimate(observations, base, "ols")
    W, y = stacked(observations, np.ones(6))
    beta, rest, *_ = np.linalg.lstsq(W, y, rcond=None)
    np.testing.assert_allclose(fitted.beta, beta, rtol=1e-8)
    white = rest[0] / (len(y) - 60) * np.linalg.inv(W.T @ W)
    np.testing.assert_allclose(np.diag(fitted.white), np.diag(white), rtol=1e-7)
    assert fitted.condition == pytest.approx(np.linalg.cond(W), rel=1e-6)
    assert fitted.condition_scaled == pytest.approx(np.linalg.cond(W / np.linalg.norm(W, axis=0)), rel=1e-6)
    assert fitted.relative_error_percent == pytest.approx(100 * np.linalg.norm(y - W @ beta) / np.linalg.norm(y))


def test_wls_is_eq_6_with_the_variances_of_eq_5(problem: tuple[list[Observation], Base]) -> None:
    observations, base = problem
    fitted = estimate(observations, base, "wls")
    for j in range(6):
        Wj = np.vstack([o.W[j, o.used[j]] for o in observations])
        yj = np.concatenate([o.y[j, o.used[j]] for o in observations])
        Wj = Wj[:, np.abs(Wj).max(axis=0) > 1e-9]
        Wj = Wj / np.linalg.norm(Wj, axis=0)
        solution, _, rank, _ = np.linalg.lstsq(Wj, yj, rcond=1e-8)
        sigma = np.linalg.norm(yj - Wj @ solution) / np.sqrt(len(yj) - rank)
        assert fitted.sigma_Nm[j] == pytest.approx(sigma, rel=1e-6)
    W, y = stacked(observations, fitted.sigma_Nm)
    np.testing.assert_allclose(fitted.beta, linalg.solve(W.T @ W, W.T @ y), rtol=1e-6)
    np.testing.assert_allclose(np.diag(fitted.white), np.diag(np.linalg.inv(W.T @ W)), rtol=1e-6)
    np.testing.assert_allclose(fitted.relative_std_percent, 100 * fitted.std / np.abs(fitted.beta))


def test_without_noise_the_truth_comes_back(tx40: Robot, make_signals: Make) -> None:
    model = Model.of(tx40)
    base = base_parameters(model)
    o = observe(prepare(make_signals(tx40, 1, 8.0)), model, base)
    fitted = estimate([o], base)
    np.testing.assert_allclose(fitted.beta, base.B @ model.theta(tx40), atol=2e-4)
    assert fitted.relative_error_percent < 0.01


def test_a_joint_at_rest_is_named_with_what_it_hides(tx40: Robot, make_signals: Make) -> None:
    signals = make_signals(tx40, 1)
    q = signals.q.copy()
    q[:, 3] = 0.2
    model = Model.of(tx40)
    base = base_parameters(model)
    with pytest.raises(IdentificationError) as error:
        estimate([observe(prepare(replace(signals, q=q)), model, base)], base)
    message = str(error.value)
    assert "Ia4" in message and "Fv4" in message and "Fc4" in message
    assert not any(name in message for name in ("Fv1", "Fc2", "ZZ2R", "Ia6", "fv_m6"))
    assert "joint4 moved by only" in message
    assert "Record a motion in which every joint moves" in message


def test_the_result_prints_as_a_report(problem: tuple[list[Observation], Base]) -> None:
    text = str(estimate(*problem))
    assert text.startswith("IDIM-WLS: 60 base parameters, ")
    assert "standard deviations: HAC (Newey-West, Bartlett kernel" in text
    assert "ZZ1R" in text and "kg·m²" in text


def tiny(seed: int, joints: int, rows: int, beta: np.ndarray) -> tuple[Observation, Base]:
    """Fixed columns, white errors."""
    columns = np.random.default_rng(99).normal(size=(joints, rows, len(beta)))
    columns[:, :, 0] = 1.0
    columns[:, :, 1] = np.sin(0.05 * np.arange(rows))
    rng = np.random.default_rng(seed)
    e = rng.normal(size=(joints, rows))
    e *= np.array([[1.0], [3.0]])
    t_s = 0.02 * np.arange(rows)
    used = np.ones((joints, rows), dtype=bool)
    names = [f"p{i}" for i in range(len(beta))]
    o = Observation("lab", ["a", "b"], t_s, t_s == 0, columns, columns @ beta + e, used, 50.0, 20.0, [])
    return o, Base(np.arange(len(beta)), np.eye(len(beta)), names, ["1"] * len(beta), names)


def test_reduction_drops_zeros_and_keeps_what_matters() -> None:
    truth = np.array([1.0, -2.0, 0.0, 0.5, 0.0, 0.0])
    o, base = tiny(5, 2, 400, truth)
    reduction = reduce(estimate([o], base))
    np.testing.assert_array_equal(reduction.essential, truth != 0)
    W, y = stacked([o], estimate([o], base).sigma_Nm)
    kept = np.linalg.lstsq(W[:, truth != 0], y, rcond=None)[0]
    np.testing.assert_allclose(reduction.beta[truth != 0], kept, rtol=1e-9)
    assert reduction.F_limit - reduction.F > 0
    assert not reduction.stopped_by_F


def test_reduction_never_drops_what_F_needs() -> None:
    """Two parameters, each badly told alone, together indispensable: F stops the reduction."""
    o, base = tiny(6, 2, 400, np.array([0.0, 0.0, 1.0, 1.0]))
    W = o.W.copy()
    W[:, :, 3] = W[:, :, 2] + 0.005 * W[:, :, 3]
    torque = W @ np.array([5.0, 5.0, 1.0, 1.0]) + (o.y - o.predict(np.array([0.0, 0.0, 1.0, 1.0])))
    reduction = reduce(estimate([replace(o, W=W, y=torque)], base))
    assert reduction.essential[:2].all()
    assert reduction.essential[2:].sum() == 1
