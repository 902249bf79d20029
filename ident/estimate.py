"""Estimates, and the least-squares methods IDIM-OLS and IDIM-WLS (Janot, Vandanjon & Gautier 2014, II.D and II.E).

Each joint's rows are first reduced to the triangle R of QR([W_j y_j]); nothing of the data is lost, and weighting
joint j by 1/sigma_j is a division of its triangle. No second pass over the data, whatever their length.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ident.base import Base
from ident.contract import Iterate, Statistic
from ident.covariance import HAC, Covariance, Moments
from ident.observation import Observation, relative_error
from ident.system import System, triangle
from protocols.errors import IdentificationError

if TYPE_CHECKING:
    from ident.problem import Problem

Array = NDArray[np.float64]

DEFICIENT = 1e-8  # singular value, columns scaled to 1, below which a motion does not show a combination
ROUNDING = 1e-13  # of the largest column: smaller ones are zeros of the structure
NEGATIVE = 3.0  # standard deviations below zero from which on a parameter is called negative
SHOWN_SHARE = 0.1  # weight of a parameter in an unseen combination from which on it is named


@dataclass(frozen=True)
class Estimate:
    """Base parameters from data.

    Attributes:
        method: Name in the literature.
        base: What the parameters are.
        beta: Values, shape (b,).
        std: Standard deviations from `covariance`, shape (b,).
        covariance: shape (b, b); how it was made is `covariance_name`.
        white: Covariance that holds for serially uncorrelated errors only, as eq. (8), shape (b, b).
        sigma_Nm: Standard deviation of the torque error per joint, shape (J,).
        system: Weighted linear system that beta solves, for model reduction; None where there is none.
        relative_error_percent, per_joint_percent: ||Y - W beta|| / ||Y||, over all rows and per joint.
        residual_rms_Nm: shape (J,).
        rows: Used, all joints.
        condition, condition_scaled: Of W, and of W with columns scaled to length 1.
        lag1: Autocorrelation of the residual at lag 1, per joint.
        notes: What the reader should know.
        iterations: Of the method; 1 for closed forms.
        converged: False where the values are those of the last iteration all the same.
        history: Every iteration, the start first; empty for closed forms.
        tests: Statistics that only this method offers.
    """

    method: str
    base: Base
    beta: Array
    std: Array
    covariance: Array
    covariance_name: str
    white: Array
    sigma_Nm: Array
    system: System | None
    relative_error_percent: float
    per_joint_percent: Array
    residual_rms_Nm: Array
    rows: int
    condition: float
    condition_scaled: float
    lag1: Array
    notes: list[str]
    iterations: int = 1
    converged: bool = True
    history: tuple[Iterate, ...] = ()
    tests: tuple[Statistic, ...] = ()

    @property
    def relative_std_percent(self) -> Array:
        """Eq. (9), shape (b,); infinite where the value is zero."""
        infinite = np.full(len(self.beta), np.inf)
        return np.asarray(100 * np.divide(self.std, np.abs(self.beta), out=infinite, where=self.beta != 0))

    def __str__(self) -> str:
        head = (
            f"{self.method}: {len(self.beta)} base parameters, {self.rows} rows,"
            f" relative error {self.relative_error_percent:.2f} %"
        )
        table = [
            f"{name:>8} {value:11.5f} ± {std:.5f} {unit}  ({relative:.1f} %)"
            for name, value, std, unit, relative in zip(
                self.base.names, self.beta, self.std, self.base.units, self.relative_std_percent, strict=True
            )
        ]
        return "\n".join([head, f"standard deviations: {self.covariance_name}", *table, *self.notes])


@dataclass(frozen=True)
class LeastSquares:
    """IDIM-OLS or IDIM-WLS.

    Attributes:
        weighted: Every joint by the standard deviation of its own sub-system, eq. (5)-(6).
        covariance: How the standard deviations are made.
    """

    weighted: bool
    covariance: Covariance = HAC

    @property
    def name(self) -> str:
        return "IDIM-WLS" if self.weighted else "IDIM-OLS"

    def fit(self, problem: "Problem") -> Estimate:
        """Least squares over all rows used.

        Raises:
            IdentificationError: The motion does not show some base parameters; names them.
        """
        return _least_squares(problem.observations, problem.base, problem.triangles, self)


def estimate(
    observations: Sequence[Observation], base: Base, method: str = "wls", covariance: Covariance = HAC
) -> Estimate:
    """IDIM-WLS (`wls`) or IDIM-OLS (`ols`) of observations alone.

    Raises:
        IdentificationError: The motion does not show some base parameters; names them.
    """
    return _least_squares(observations, base, joint_triangles(observations), LeastSquares(method == "wls", covariance))


def joint_triangles(observations: Sequence[Observation]) -> list[Array]:
    """R of QR([W_j y_j]) of every joint over all recordings, J of shape (b+1, b+1)."""
    with threadpool_limits(limits=1, user_api="blas"):  # two threads on columns as few as these are ten times slower
        return [
            triangle([np.column_stack([o.W[j, o.used[j]], o.y[j, o.used[j]]]) for o in observations])
            for j in range(len(observations[0].joints))
        ]


def joint_rows(observations: Sequence[Observation]) -> NDArray[np.int64]:
    """Rows used per joint, shape (J,)."""
    return np.asarray(sum(o.used.sum(axis=1) for o in observations))


def _least_squares(
    observations: Sequence[Observation], base: Base, triangles: Sequence[Array], method: LeastSquares
) -> Estimate:
    joints, b = len(observations[0].joints), len(base.names)
    whole = triangle(triangles)
    refuse_deficient(whole[:, :b], base, observations)
    counts = joint_rows(observations)
    sigma = joint_sigma(triangles, counts)
    freedom = max(1, int(counts.sum()) - b)
    used = sigma if method.weighted else np.full(joints, _residual_norm(whole, b) / np.sqrt(freedom))
    system = System.of_triangle(triangle([t / s for t, s in zip(triangles, used, strict=True)]))
    solution = system.solve()
    moments = Moments.weighted(observations, solution.beta, used, solution.inverse @ solution.inverse.T)
    covariance, words = method.covariance.of(moments)
    return assemble(
        observations,
        base,
        method.name,
        solution.beta,
        covariance=covariance,
        covariance_name=words,
        white=moments.white,
        sigma_Nm=sigma,
        system=system,
        triangles=triangles,
    )


def assemble(
    observations: Sequence[Observation],
    base: Base,
    method: str,
    beta: Array,
    *,
    covariance: Array,
    covariance_name: str,
    white: Array,
    sigma_Nm: Array,
    system: System | None = None,
    triangles: Sequence[Array] | None = None,
    notes: Sequence[str] = (),
    iterations: int = 1,
    converged: bool = True,
    history: Sequence[Iterate] = (),
    tests: Sequence[Statistic] = (),
) -> Estimate:
    """Estimate of values that a method has found: all that can be said of them on the rows Y = W beta + rho.

    Args:
        triangles: `joint_triangles(observations)`, where the method has them already.
    """
    b, joints = len(base.names), len(observations[0].joints)
    scaled, condition = conditions(triangle(triangles or joint_triangles(observations))[:, :b])
    residuals = [o.y - o.predict(beta) for o in observations]
    lag1 = np.array([_lag1(observations, residuals, j) for j in range(joints)])
    error, per_joint = relative_error(observations, beta)
    return Estimate(
        method=method,
        base=base,
        beta=beta,
        std=np.sqrt(np.diag(covariance)),
        covariance=covariance,
        covariance_name=covariance_name,
        white=white,
        sigma_Nm=sigma_Nm,
        system=system,
        relative_error_percent=error,
        per_joint_percent=per_joint,
        residual_rms_Nm=np.array([_rms(observations, residuals, j) for j in range(joints)]),
        rows=int(joint_rows(observations).sum()),
        condition=condition,
        condition_scaled=scaled,
        lag1=lag1,
        notes=[
            *(n for o in observations for n in o.notes),
            *_autocorrelation_note(observations[0].joints, lag1, covariance_name),
            *negative_notes(base, beta, np.sqrt(np.diag(covariance)), observations[0].joints),
            *notes,
        ],
        iterations=iterations,
        converged=converged,
        history=tuple(history),
        tests=tuple(tests),
    )


def joint_sigma(triangles: Sequence[Array], rows: NDArray[np.int64]) -> Array:
    """Standard deviation of every joint's error by its own sub-system, eq. (5), shape (J,)."""
    return np.array([_joint_sigma(t, int(n)) for t, n in zip(triangles, rows, strict=True)])


def _joint_sigma(factor: Array, rows: int) -> float:
    """Standard deviation of one joint's error by its own least squares, eq. (5)."""
    if rows == 0:
        return 1.0  # no rows to weight
    A, y = factor[:, :-1], factor[:, -1]
    norms = np.linalg.norm(A, axis=0)
    active = norms > ROUNDING * norms.max(initial=0.0)
    solution, _, rank, _ = np.linalg.lstsq(A[:, active] / norms[active], y, rcond=DEFICIENT)
    residual = np.linalg.norm(y - (A[:, active] / norms[active]) @ solution)
    return max(float(residual / np.sqrt(max(1, rows - rank))), float(np.finfo(float).tiny))


def _residual_norm(factor: Array, b: int) -> float:
    return float(abs(factor[b, b]))


def conditions(A: Array) -> tuple[float, float]:
    """Condition of the column-scaled and of the raw matrix; infinite for a column of zeros."""
    norms = np.linalg.norm(A, axis=0)
    if not norms.all():
        return float("inf"), float("inf")
    return float(np.linalg.cond(A / norms)), float(np.linalg.cond(A))


def refuse_deficient(A: Array, base: Base, observations: Sequence[Observation]) -> None:
    """A parameter whose column is zero or depends on others on this motion cannot be told.

    Args:
        A: Triangle of the columns, shape (b or more, b).

    Raises:
        IdentificationError: There are such parameters; names them.
    """
    rows = sum(o.used.size for o in observations)
    if rows < len(base.names):
        raise IdentificationError(
            f"{rows} rows at {observations[0].rate_Hz:.0f} Hz for {len(base.names)} parameters. Record longer, or"
            " decimate less."
        )
    refuse_hidden(A, base, " ".join(n for o in observations for n in o.notes if "moved by only" in n))


def refuse_hidden(A: Array, base: Base, still: str) -> None:
    """As `refuse_deficient`; `still` says which joints were at rest."""
    norms = np.linalg.norm(A, axis=0)
    unseen = norms <= DEFICIENT * norms.max(initial=0.0)
    _, values, rows = np.linalg.svd(A / np.where(unseen, 1.0, norms))
    hidden = values < DEFICIENT * values[0]
    lost = unseen | (np.abs(rows[hidden]) > SHOWN_SHARE).any(axis=0)
    if lost.any():
        names = ", ".join(name for name, out in zip(base.names, lost, strict=True) if out)
        raise IdentificationError(
            f"This motion does not show {int(hidden.sum())} of {len(base.names)} combinations of parameters; involved:"
            f" {names}. {still + ' ' if still else ''}Record a motion in which every joint moves, fast and slow, in"
            " several poses."
        )


def _rms(observations: Sequence[Observation], residuals: Sequence[Array], joint: int) -> float:
    used = np.concatenate([r[joint, o.used[joint]] for o, r in zip(observations, residuals, strict=True)])
    return float(np.sqrt(np.mean(used**2))) if used.size else float("nan")


def _lag1(observations: Sequence[Observation], residuals: Sequence[Array], joint: int) -> float:
    """Correlation of neighbouring residuals, both used and in the same gapless stretch."""
    product = square = 0.0
    for o, r in zip(observations, residuals, strict=True):
        pair = o.used[joint, 1:] & o.used[joint, :-1] & ~o.first[1:]
        product += float(r[joint, 1:][pair] @ r[joint, :-1][pair])
        square += float((r[joint, 1:][pair] ** 2).sum() + (r[joint, :-1][pair] ** 2).sum()) / 2
    return product / square if square > 0 else float("nan")


def _autocorrelation_note(joints: list[str], lag1: Array, covariance: str) -> list[str]:
    values = ", ".join(f"{name} {value:+.2f}" for name, value in zip(joints, lag1, strict=True))
    allowed = "assume that there is none" if covariance.startswith("white") else "allow for it, eq. (8) does not"
    return [f"Residual autocorrelation at lag 1: {values}. The standard deviations {allowed}."]


def negative_notes(base: Base, beta: Array, std: Array, joints: Sequence[str]) -> list[str]:
    """Frictions and rotor inertias far below zero, which no axis has: most often a sign in the data."""
    found: dict[int, list[str]] = {}
    kinds: dict[int, set[str]] = {}
    for index, value, deviation in zip(base.kept, beta, std, strict=True):
        name = base.standard[index]
        kind = name.rstrip("0123456789")
        number = int(name[len(kind) :])
        axis = kind in ("Fv", "Fc", "Ia") or (kind == "ZZ" and number == 1)
        if axis and value < -NEGATIVE * deviation:
            found.setdefault(number - 1, []).append(f"{name} = {value:.3g} ± {deviation:.2g}")
            kinds.setdefault(number - 1, set()).add(kind)
    notes = []
    for j, words in sorted(found.items()):
        text = f"{joints[j]}: {', '.join(words)} {'are' if len(words) > 1 else 'is'} negative, which no axis can be."
        if {"Fv", "Fc"} <= kinds[j]:
            text += (
                " Torque and position of this axis have opposite signs: check gear_ratio and the sign of the current."
            )
        else:
            text += (
                " The motion may not show it, or the model lacks an effect: look at its deviation and the residuals."
            )
        notes.append(text)
    return notes
