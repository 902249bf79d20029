"""IDIM-OLS and IDIM-WLS (Janot, Vandanjon & Gautier 2014, II.D and II.E) on per-joint triangular factors.

Each joint's rows are first reduced to the triangle R of QR([W_j y_j]); nothing of the data is lost, and weighting
joint j by 1/sigma_j is a division of its triangle. No second pass over the data, whatever their length.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ident.base import Base
from ident.covariance import hac
from ident.observation import Observation, relative_error
from protocols.errors import IdentificationError

Array = NDArray[np.float64]

METHODS = {"ols": "IDIM-OLS", "wls": "IDIM-WLS"}
DEFICIENT = 1e-8  # singular value, columns scaled to 1, below which a motion does not show a combination
ROUNDING = 1e-13  # of the largest column: smaller ones are zeros of the structure
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
        white: Covariance of eq. (8), which holds for serially uncorrelated errors only, shape (b, b).
        sigma_Nm: Standard deviation of the error per joint, from the joint's own sub-system, shape (J,).
        triangle: R of QR([W y]) weighted by the method, shape (b+1, b+1).
        relative_error_percent, per_joint_percent: ||Y - W beta|| / ||Y||, over all rows and per joint.
        residual_rms_Nm: shape (J,).
        rows: Used, all joints.
        condition, condition_scaled: Of W, and of W with columns scaled to length 1.
        lag1: Autocorrelation of the residual at lag 1, per joint.
        notes: What the reader should know.
    """

    method: str
    base: Base
    beta: Array
    std: Array
    covariance: Array
    covariance_name: str
    white: Array
    sigma_Nm: Array
    triangle: Array
    relative_error_percent: float
    per_joint_percent: Array
    residual_rms_Nm: Array
    rows: int
    condition: float
    condition_scaled: float
    lag1: Array
    notes: list[str]

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


def estimate(observations: Sequence[Observation], base: Base, method: str = "wls") -> Estimate:
    """Least squares over all rows used.

    Args:
        method: A key of `METHODS`.

    Raises:
        IdentificationError: The motion does not show some base parameters; names them.
    """
    joints = len(observations[0].joints)
    b = len(base.names)
    triangles = [
        triangle([np.column_stack([o.W[j, o.used[j]], o.y[j, o.used[j]]]) for o in observations]) for j in range(joints)
    ]
    counts = np.array([sum(int(o.used[j].sum()) for o in observations) for j in range(joints)])
    whole = triangle(triangles)
    scaled, condition = _conditions(whole[:, :b])
    _refuse_deficient(whole[:, :b], base, observations)
    sigma = np.array([_joint_sigma(t, n) for t, n in zip(triangles, counts, strict=True)])
    if method == "ols":
        freedom = max(1, counts.sum() - b)
        sigma_used = np.full(joints, _residual_norm(whole, b) / np.sqrt(freedom))
    else:
        sigma_used = sigma
    weighted = triangle([t / s for t, s in zip(triangles, sigma_used, strict=True)])
    R = weighted[:b, :b]
    beta = linalg.solve_triangular(R, weighted[:b, b])
    inverse = linalg.solve_triangular(R, np.eye(b))
    white = inverse @ inverse.T
    covariance, lags = hac(observations, beta, sigma_used, inverse)
    residuals = [o.y - o.predict(beta) for o in observations]
    lag1 = np.array([_lag1(observations, residuals, j) for j in range(joints)])
    error, per_joint = relative_error(observations, beta)
    rms = np.array([_rms(observations, residuals, j) for j in range(joints)])
    return Estimate(
        method=METHODS[method],
        base=base,
        beta=beta,
        std=np.sqrt(np.diag(covariance)),
        covariance=covariance,
        covariance_name=f"HAC (Newey-West, Bartlett kernel, {lags} lags), joints at one instant may correlate",
        white=white,
        sigma_Nm=sigma,
        triangle=weighted,
        relative_error_percent=error,
        per_joint_percent=per_joint,
        residual_rms_Nm=rms,
        rows=int(counts.sum()),
        condition=condition,
        condition_scaled=scaled,
        lag1=lag1,
        notes=[note for o in observations for note in o.notes] + _autocorrelation_note(observations[0].joints, lag1),
    )


def triangle(blocks: Sequence[Array]) -> Array:
    """R of the QR decomposition of stacked rows, shape (c, c); blocks may themselves be such triangles."""
    rows = np.vstack(blocks)
    columns = rows.shape[1]
    if len(rows) < columns:
        rows = np.vstack([rows, np.zeros((columns - len(rows), columns))])
    return np.asarray(linalg.qr(rows, mode="r", check_finite=False)[0][:columns])


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


def _conditions(A: Array) -> tuple[float, float]:
    """Condition of the column-scaled and of the raw matrix; infinite for a column of zeros."""
    norms = np.linalg.norm(A, axis=0)
    if not norms.all():
        return float("inf"), float("inf")
    return float(np.linalg.cond(A / norms)), float(np.linalg.cond(A))


def _refuse_deficient(A: Array, base: Base, observations: Sequence[Observation]) -> None:
    """A parameter whose column is zero or depends on others on this motion cannot be told."""
    norms = np.linalg.norm(A, axis=0)
    unseen = norms <= DEFICIENT * norms.max(initial=0.0)
    _, values, rows = np.linalg.svd(A / np.where(unseen, 1.0, norms))
    hidden = values < DEFICIENT * values[0]
    lost = unseen | (np.abs(rows[hidden]) > SHOWN_SHARE).any(axis=0)
    if lost.any():
        names = ", ".join(name for name, out in zip(base.names, lost, strict=True) if out)
        still = " ".join(n for o in observations for n in o.notes if "moved by only" in n)
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


def _autocorrelation_note(joints: list[str], lag1: Array) -> list[str]:
    values = ", ".join(f"{name} {value:+.2f}" for name, value in zip(joints, lag1, strict=True))
    return [f"Residual autocorrelation at lag 1: {values}. The standard deviations allow for it, eq. (8) does not."]
