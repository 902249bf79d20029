"""Essential parameters: reduction of the model as far as the F statistic accepts (Janot et al. 2014, IV.C)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats

from ident.estimate import Estimate

Array = NDArray[np.float64]

ESSENTIAL_PERCENT = 30.0  # relative standard deviation above which a parameter may be dropped (paper, IV.C)
LEVEL = 0.05  # of the F test


@dataclass(frozen=True)
class Reduction:
    """The reduced model.

    Attributes:
        essential: Which base parameters stay, shape (b,).
        beta, std: Of the reduced model, zero where dropped, shape (b,); std by eq. (8).
        F, F_limit: Of the last accepted step, with its 95 % quantile; NaN where nothing was dropped.
        p_value: Of the same.
        stopped_by_F: The next parameter was above `ESSENTIAL_PERCENT`, but F rejected its removal.
    """

    essential: NDArray[np.bool_]
    beta: Array
    std: Array
    F: float
    F_limit: float
    p_value: float
    stopped_by_F: bool


def reduce(estimate: Estimate) -> Reduction:
    """Drop the parameter of largest relative standard deviation, refit, and go on while F accepts.

    The relative deviations and F are those of uncorrelated errors, as in the paper; with correlated residuals F
    rejects too early, which keeps parameters rather than losing them.
    """
    b = len(estimate.beta)
    R = estimate.triangle
    full = float(R[b, b] ** 2)
    freedom = max(1, estimate.rows - b)
    essential = np.ones(b, dtype=bool)
    beta, std, _ = _solve(R, essential)
    result = Reduction(essential.copy(), beta, std, float("nan"), float("nan"), float("nan"), False)
    while essential.sum() > 1:
        relative = np.divide(100 * std, np.abs(beta), out=np.full(b, np.inf), where=beta != 0)
        relative[~essential] = -1.0
        weakest = int(np.argmax(relative))
        if relative[weakest] <= ESSENTIAL_PERCENT:
            break
        essential[weakest] = False
        beta, std, rest = _solve(R, essential)
        dropped = int(b - essential.sum())
        F = (rest - full) / full * freedom / dropped
        limit = float(stats.f.ppf(1 - LEVEL, dropped, freedom))
        if limit < F:
            return Reduction(
                result.essential, result.beta, result.std, result.F, result.F_limit, result.p_value, stopped_by_F=True
            )
        p_value = float(stats.f.sf(F, dropped, freedom))
        result = Reduction(essential.copy(), beta, std, float(F), limit, p_value, stopped_by_F=False)
    return result


def _solve(R: Array, essential: NDArray[np.bool_]) -> tuple[Array, Array, float]:
    """Least squares with some columns of a triangle: values, eq. (8) deviations (unit weight), squared residual."""
    b = len(essential)
    factor = linalg.qr(R[:, [*np.flatnonzero(essential), b]], mode="r")[0]
    kept = int(essential.sum())
    inverse = linalg.solve_triangular(factor[:kept, :kept], np.eye(kept))
    beta, std = np.zeros(b), np.zeros(b)
    beta[essential] = inverse @ factor[:kept, kept]
    std[essential] = np.linalg.norm(inverse, axis=1)
    return beta, std, float(np.sum(factor[kept:, kept] ** 2))
