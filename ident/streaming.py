"""Least squares on recordings of any length at constant memory, at the full rate.

Pieces of the signals are filtered with a margin, turned into rows block by block, and each joint's rows go into one
small factor over the columns that this joint can have. Weights come from the factors, so the data are read once.

There is no parallel decimation: torque noise beyond the motion's bandwidth stays in the rows. The estimate is the
worse for it by little, because there are many, and the covariance, from means over batches, is honest about it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ident.base import Base
from ident.dataset import FILTER_HZ, Segment, Signals, pieces, plan_stretches
from ident.estimate import Estimate, conditions, joint_sigma, refuse_hidden
from ident.model import Model
from ident.observation import SLOW, STILL, usable
from ident.system import System, triangle
from ident.triangles import Factor
from protocols.errors import DataError

Array = NDArray[np.float64]

BLOCK = 2048  # samples whose columns are in memory at a time: six axes are 8 MB
SHORTEST = 2  # blocks in a batch at first
BATCHES = 64  # kept at most twice as many; the spread of their scores has as many degrees of freedom
STRUCTURE_STATES = 50  # random states that show which columns a joint can have
CHORD_S = 0.02  # over which the peak speed is taken from positions as recorded


@dataclass(frozen=True)
class Reduced:
    """What is left of the recordings.

    Attributes:
        sources: Names of the recordings.
        joints: Joint names.
        triangles: R of QR([W_j y_j]) of every joint, J of shape (b+1, b+1).
        rows: Used per joint, shape (J,).
        batches: The same triangles of consecutive batches of equal length.
        batch_s: Length of a batch.
        notes: What was left out and why.
    """

    sources: list[str]
    joints: list[str]
    triangles: list[Array]
    rows: NDArray[np.int64]
    batches: list[list[Array]]
    batch_s: float
    notes: list[str]


def estimate_stream(
    recordings: Sequence[Signals],
    model: Model,
    base: Base,
    filter_Hz: float = FILTER_HZ,
    speed_threshold: float | None = None,
    *,
    weighted: bool = True,
) -> Estimate:
    """IDIM-WLS, or -OLS, of recordings of any length.

    Raises:
        DataError, ConfigError: As `ident.dataset.prepare`.
        IdentificationError: The motion does not show some base parameters; names them.
    """
    return solve(reduce_stream(recordings, model, base, filter_Hz, speed_threshold), base, weighted=weighted)


def reduce_stream(
    recordings: Sequence[Signals],
    model: Model,
    base: Base,
    filter_Hz: float = FILTER_HZ,
    speed_threshold: float | None = None,
) -> Reduced:
    """Recordings to one triangle per joint.

    Args:
        speed_threshold: Rows slower than this are not used [rad/s]; 0 keeps all, None is a share of the peak speed.
    """
    active = _structure(model, base)
    b = len(base.kept)
    batches = _Batches([len(a) + 1 for a in active])
    notes: list[str] = []
    period = 0.0
    buffer = model.regressor(*np.zeros((3, BLOCK, model.joints)))
    # Two BLAS threads on blocks as small as these ran 70 times slower than one.
    with threadpool_limits(limits=1, user_api="blas"):
        for signals in recordings:
            plan = plan_stretches(signals, filter_Hz)
            notes += plan.notes
            if period and abs(plan.period_s - period) > 1e-3 * period:
                raise DataError(
                    f"{signals.source} is sampled at {1 / plan.period_s:.0f} Hz, the recordings before it at"
                    f" {1 / period:.0f} Hz. Identify them one by one, or with decimation."
                )
            period = plan.period_s
            slow, still = _slow(signals, plan.period_s, speed_threshold)
            notes += still
            for piece in pieces(signals, plan, filter_Hz):
                for part in _blocks(piece):
                    batches.feed(_rows(part, model, base, active, slow, buffer), part.t_s.size)
        triangles = [_spread(t, a, b) for t, a in zip(batches.total(), active, strict=True)]
        parts = [[_spread(t, a, b) for t, a in zip(batch, active, strict=True)] for batch in batches.done]
    names = [s.source for s in recordings]
    return Reduced(names, recordings[0].joints, triangles, batches.rows, parts, batches.length * period, notes)


def solve(reduced: Reduced, base: Base, *, weighted: bool = True) -> Estimate:
    """Least squares on reduced recordings."""
    with threadpool_limits(limits=1, user_api="blas"):
        return _solve(reduced, base, weighted)


def _solve(reduced: Reduced, base: Base, weighted: bool) -> Estimate:
    joints, b = len(reduced.joints), len(base.kept)
    whole = triangle(reduced.triangles)
    refuse_hidden(whole[:, :b], base, " ".join(n for n in reduced.notes if "moved by only" in n))
    sigma = joint_sigma(reduced.triangles, reduced.rows)
    freedom = max(1, int(reduced.rows.sum()) - b)
    used = sigma if weighted else np.full(joints, abs(whole[b, b]) / np.sqrt(freedom))
    system = System.of_triangle(triangle([t / s for t, s in zip(reduced.triangles, used, strict=True)]))
    solution = system.solve()
    white = solution.inverse @ solution.inverse.T
    covariance, words = _batch_means(reduced, solution.beta, used, white)
    ends = [(np.linalg.norm(t @ np.append(solution.beta, -1.0)), np.linalg.norm(t[:, b])) for t in reduced.triangles]
    rest, torque = np.array(ends).T
    scaled, condition = conditions(whole[:, :b])
    return Estimate(
        method="IDIM-WLS" if weighted else "IDIM-OLS",
        base=base,
        beta=solution.beta,
        std=np.sqrt(np.diag(covariance)),
        covariance=covariance,
        covariance_name=words,
        white=white,
        sigma_Nm=sigma,
        system=system,
        relative_error_percent=100 * float(np.linalg.norm(rest) / np.linalg.norm(torque)),
        per_joint_percent=100 * np.divide(rest, torque, out=np.full(joints, np.nan), where=torque > 0),
        residual_rms_Nm=rest / np.sqrt(np.maximum(reduced.rows, 1)),
        rows=int(reduced.rows.sum()),
        condition=condition,
        condition_scaled=scaled,
        lag1=np.full(joints, np.nan),
        notes=[*reduced.notes, "Read once at the full rate: residuals were not kept, so tests of them do not apply."],
    )


def _batch_means(reduced: Reduced, beta: Array, sigma: Array, bread: Array) -> tuple[Array, str]:
    """Covariance from the spread of the batches' scores: errors may have any memory short against a batch."""
    b, K = len(beta), len(reduced.batches)
    if K < 2:
        return bread, "white (eq. (8)): the recording is too short for batches"
    scores = np.array(
        [
            sum(-t[:, :b].T @ (t @ np.append(beta, -1.0)) / s**2 for t, s in zip(batch, sigma, strict=True))
            for batch in reduced.batches
        ]
    )
    scores -= scores.mean(axis=0)
    S = scores.T @ scores * K / (K - 1)
    return bread @ S @ bread, f"batch means ({K} batches of {reduced.batch_s:.2f} s)"


class _Batches:
    """Factors of consecutive batches; when there are too many, neighbours are merged and batches grow twice as long."""

    def __init__(self, columns: Sequence[int]) -> None:
        self.columns = columns
        self.rows = np.zeros(len(columns), dtype=np.int64)
        self.length = SHORTEST * BLOCK
        self.done: list[list[Array]] = []
        self._current = [Factor(c) for c in columns]
        self._samples = 0

    def feed(self, rows: Sequence[Array], samples: int) -> None:
        """One block's rows per joint, and the samples it spans."""
        for factor, joint in zip(self._current, rows, strict=True):
            factor.feed(joint)
        self.rows += [len(joint) for joint in rows]
        self._samples += samples
        if self._samples >= self.length:
            self.done.append([f.triangle() for f in self._current])
            self._current = [f.successor() for f in self._current]
            self._samples = 0
            if len(self.done) == 2 * BATCHES:
                pairs = zip(self.done[::2], self.done[1::2], strict=True)
                self.done = [[triangle([x, y]) for x, y in zip(a, c, strict=True)] for a, c in pairs]
                self.length *= 2

    def total(self) -> list[Array]:
        """Factor of everything, per joint."""
        last = [f.triangle() for f in self._current]
        return [triangle([*(batch[j] for batch in self.done), last[j]]) for j in range(len(self.columns))]


def _structure(model: Model, base: Base) -> list[NDArray[np.int64]]:
    """Base columns that each joint's rows can have."""
    states = np.random.default_rng(1).standard_normal((3, STRUCTURE_STATES, model.joints))
    W = model.regressor(*states)[:, :, base.kept]
    return [np.flatnonzero(np.abs(W[j]).max(axis=0) > 0) for j in range(model.joints)]


def _spread(factor: Array, active: NDArray[np.int64], b: int) -> Array:
    """Triangle over all base columns and the torque."""
    out = np.zeros((len(factor), b + 1))
    out[:, [*active, b]] = factor
    return triangle([out])


def _slow(signals: Signals, period: float, threshold: float | None) -> tuple[Array, list[str]]:
    """Speeds below which rows are not used, shape (J,), and notes about joints at rest."""
    span = np.ptp(signals.q, axis=0)
    still = span < STILL
    if threshold is None:
        reach = max(1, round(CHORD_S / period))
        peak = np.array([np.abs(c[reach:] - c[:-reach]).max(initial=0.0) for c in signals.q.T]) / (reach * period)
        slow = SLOW * peak
    else:
        slow = np.full(len(span), threshold)
    notes = [
        f"{signals.source}: {name} moved by only {s:.2g} rad; its rows are not used."
        for name, s in zip(np.array(signals.joints)[still], span[still], strict=True)
    ]
    return np.where(still, np.inf, slow), notes


def _blocks(piece: Segment) -> Iterator[Segment]:
    for start in range(0, piece.t_s.size, BLOCK):
        part = slice(start, start + BLOCK)
        yield Segment(piece.t_s[part], piece.q[part], piece.qd[part], piece.qdd[part], piece.tau_Nm[part])


def _rows(
    part: Segment, model: Model, base: Base, active: Sequence[NDArray[np.int64]], slow: Array, buffer: Array
) -> list[Array]:
    """[W_j y_j] of the rows used, per joint.

    Args:
        buffer: Columns of a block of full length, overwritten.
    """
    W = model.regressor(part.q, part.qd, part.qdd, buffer if part.t_s.size == buffer.shape[1] else None)
    used = usable(model, part.qd, slow)
    out = []
    for j, columns in enumerate(active):
        rows = np.empty((part.t_s.size, len(columns) + 1))
        np.take(W[j], base.kept[columns], axis=1, out=rows[:, :-1])
        rows[:, -1] = part.tau_Nm[:, j]
        out.append(rows if used[j].all() else rows[used[j]])
    return out
