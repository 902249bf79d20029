"""Recordings of any length: the same numbers as from one piece, at constant memory."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from ident import streaming
from ident.base import Base, base_parameters
from ident.covariance import White
from ident.dataset import Segment, Signals, pieces, plan_stretches, prepare
from ident.estimate import estimate
from ident.model import Model
from ident.observation import observe
from ident.reduction import reduce
from ident.streaming import estimate_stream, reduce_stream
from ident.triangles import Factor
from protocols.errors import DataError, IdentificationError
from protocols.robot import Robot

Make = Callable[..., Signals]


def ill_conditioned(condition: float, rows: int = 20_000, columns: int = 12) -> np.ndarray:
    rng = np.random.default_rng(1)
    U = np.linalg.qr(rng.normal(size=(rows, columns)))[0]
    V = np.linalg.qr(rng.normal(size=(columns, columns)))[0]
    return (U * np.geomspace(1, 1 / condition, columns)) @ V.T


def solution(R: np.ndarray) -> np.ndarray:
    return np.linalg.solve(R[:-1, :-1], R[:-1, -1])


@pytest.mark.parametrize("condition", [1e2, 1e6, 1e9])
def test_factor_is_as_accurate_as_qr(condition: float) -> None:
    W = ill_conditioned(condition)
    y = W @ np.ones(12) + 1e-3 / condition * np.random.default_rng(2).normal(size=len(W))
    rows = np.column_stack([W, y])
    factor = Factor(13)
    for block in np.array_split(rows, 300):
        factor.feed(block)
    exact = np.linalg.lstsq(W, y, rcond=None)[0]
    error = np.abs(solution(factor.triangle()) - exact).max()
    assert error < 1e-6  # QR: 2e-10, of standard deviations of 1e-4
    assert factor.rows == len(rows)


def test_normal_equations_are_not() -> None:
    """The negative control: squared columns lose what the factor keeps."""
    W = ill_conditioned(1e9)
    y = W @ np.ones(12)
    assert np.abs(np.linalg.solve(W.T @ W, W.T @ y) - 1).max() > 1e-2


def test_what_moves_late_counts_as_what_moves_early() -> None:
    rng = np.random.default_rng(3)
    blocks = [rng.normal(size=(500, 5)) * [1, 1, 0 if k < 40 else 1, 1e-7 if k < 40 else 10, 1] for k in range(80)]
    factor = Factor(5)
    for block in blocks:
        factor.feed(block)
    whole = np.vstack(blocks)
    np.testing.assert_allclose(factor.triangle().T @ factor.triangle(), whole.T @ whole, rtol=1e-9, atol=1e-7)


def test_an_empty_factor_is_zero_and_successors_start_empty() -> None:
    factor = Factor(3)
    np.testing.assert_array_equal(factor.triangle(), np.zeros((3, 3)))
    factor.feed(np.zeros((0, 3)))
    rows = np.random.default_rng(0).normal(size=(50, 3))
    factor.feed(rows)
    after = factor.successor()
    np.testing.assert_array_equal(after.triangle(), np.zeros((3, 3)))
    after.feed(rows)
    np.testing.assert_allclose(after.triangle().T @ after.triangle(), rows.T @ rows, rtol=1e-12)


def with_gap(signals: Signals) -> Signals:
    keep = np.r_[0:2500, 2600:6000]
    return replace(signals, t_s=signals.t_s[keep], q=signals.q[keep], tau_Nm=signals.tau_Nm[keep])


@pytest.mark.parametrize("filter_Hz", [50.0, 20.0, np.inf])
def test_pieces_are_the_whole(tx40: Robot, make_signals: Make, filter_Hz: float) -> None:
    signals = with_gap(make_signals(tx40, 1, 6.0, noise_Nm=0.5, delay_s=0.0005))
    whole = prepare(signals, filter_Hz).segments
    plan = plan_stretches(signals, filter_Hz)
    parts = list(pieces(signals, plan, filter_Hz, rows=700))
    assert len(parts) > len(whole) == 2
    for name, size in (("t_s", 1.0), ("q", 1.0), ("tau_Nm", 10.0), ("qd", 10.0), ("qdd", 1e3)):
        ours = np.concatenate([getattr(p, name) for p in parts])
        theirs = np.concatenate([getattr(s, name) for s in whole])
        np.testing.assert_allclose(ours, theirs, atol=1e-12 * size * (1 if name != "qdd" else 100), rtol=0)


@pytest.fixture(scope="module")
def problem(tx40: Robot, make_signals: Make) -> tuple[list[Signals], Model, Base]:
    model = Model.of(tx40)
    return [with_gap(make_signals(tx40, s, 6.0, noise_Nm=0.5)) for s in (1, 2)], model, base_parameters(model)


def test_stream_is_estimate_at_the_full_rate(
    problem: tuple[list[Signals], Model, Base], monkeypatch: pytest.MonkeyPatch
) -> None:
    runs, model, base = problem
    monkeypatch.setattr(streaming, "BLOCK", 512)
    for weighted, method in ((True, "wls"), (False, "ols")):
        streamed = estimate_stream(runs, model, base, speed_threshold=0.05, weighted=weighted)
        whole = estimate([observe(prepare(s), model, base, np.inf, 0.05) for s in runs], base, method, White())
        np.testing.assert_allclose(streamed.beta, whole.beta, atol=1e-8)
        np.testing.assert_allclose(np.diag(streamed.white), np.diag(whole.white), rtol=1e-6)
        np.testing.assert_allclose(streamed.sigma_Nm, whole.sigma_Nm, rtol=1e-8)
        np.testing.assert_allclose(streamed.per_joint_percent, whole.per_joint_percent, rtol=1e-8)
        assert streamed.relative_error_percent == pytest.approx(whole.relative_error_percent)
        assert streamed.rows == whole.rows
        assert streamed.condition_scaled == pytest.approx(whole.condition_scaled, rel=1e-6)
        assert reduce(streamed).essential.tolist() == reduce(whole).essential.tolist()
        assert any("2 stretches" not in n and "1 gaps" in n for n in streamed.notes)


def test_batch_means_know_what_white_does_not(
    problem: tuple[list[Signals], Model, Base], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Torque errors that last 20 samples: the truth lies within the batches' deviations, not within white ones."""
    runs, model, base = problem
    monkeypatch.setattr(streaming, "BLOCK", 128)
    monkeypatch.setattr(streaming, "SHORTEST", 1)
    truth = base.B @ model.theta(model.robot)
    rng = np.random.default_rng(7)
    z = []
    for run in runs * 2:
        held = np.repeat(rng.normal(size=(run.t_s.size // 20 + 1, 6)), 20, axis=0)[: run.t_s.size]
        fitted = estimate_stream([replace(run, tau_Nm=run.tau_Nm + held)], model, base, speed_threshold=0.05)
        assert fitted.covariance_name.startswith("batch means (")
        z.append([(fitted.beta - truth) / fitted.std, (fitted.beta - truth) / np.sqrt(np.diag(fitted.white))])
    ours, white = np.sqrt(np.mean(np.square(z), axis=(0, 2)))
    assert ours < 2.0
    assert white > 2.5


def test_batches_merge_and_stay_few(
    problem: tuple[list[Signals], Model, Base], monkeypatch: pytest.MonkeyPatch
) -> None:
    runs, model, base = problem
    monkeypatch.setattr(streaming, "BLOCK", 16)
    monkeypatch.setattr(streaming, "SHORTEST", 1)
    monkeypatch.setattr(streaming, "BATCHES", 8)
    reduced = reduce_stream(runs[:1], model, base, speed_threshold=0.0)
    assert 8 <= len(reduced.batches) < 16
    assert reduced.batch_s == pytest.approx(16 * 2 ** round(np.log2(reduced.batch_s / 0.016)) * 0.001)
    for j in range(6):
        parts = sum(b[j].T @ b[j] for b in reduced.batches)
        whole = reduced.triangles[j].T @ reduced.triangles[j]
        assert (np.diag(parts) <= np.diag(whole) * (1 + 1e-9)).all()
        assert np.trace(parts) > 0.8 * np.trace(whole)


def test_refusals_are_those_of_the_whole(problem: tuple[list[Signals], Model, Base]) -> None:
    runs, model, base = problem
    q = runs[0].q.copy()
    q[:, 3] = 0.1
    with pytest.raises(IdentificationError, match=r"involved: .*Fv4.* joint4 moved by only 0 rad"):
        estimate_stream([replace(runs[0], q=q)], model, base)
    slower = replace(runs[1], t_s=2 * runs[1].t_s)
    with pytest.raises(DataError, match="motion 2 is sampled at 500 Hz, the recordings before it at 1000 Hz"):
        estimate_stream([runs[0], slower], model, base)


def test_a_segment_s_blocks_are_the_segment() -> None:
    t = np.arange(5000.0)
    columns = t[:, None]
    blocks = list(streaming._blocks(Segment(t, columns, columns, columns, columns)))
    np.testing.assert_array_equal(np.concatenate([b.t_s for b in blocks]), t)
