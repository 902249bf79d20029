"""Essential parameters: reduction of the model as far as the F statistic accepts (Janot et al. 2014, IV.C)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from ident.estimate import Estimate

Array = NDArray[np.float64]

ESSENTIAL_PERCENT = 30.0  # relative standard deviation above which a parameter may be dropped (paper, IV.C)
LEVEL = 0.05  # of the F test
CONFUSED = 0.95  # correlation of two estimates from which on they are one combination


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
    system = estimate.system
    if system is None:  # nothing to refit: the large relative deviations are all there is to go by
        essential = estimate.relative_std_percent <= ESSENTIAL_PERCENT
        beta, std = np.where(essential, estimate.beta, 0.0), np.where(essential, estimate.std, 0.0)
        return Reduction(essential, beta, std, float("nan"), float("nan"), float("nan"), stopped_by_F=False)
    solution = system.solve()
    full = solution.rest
    freedom = max(1, estimate.rows - b)
    essential = np.ones(b, dtype=bool)
    beta, std = solution.beta, solution.std
    result = Reduction(essential.copy(), beta, std, float("nan"), float("nan"), float("nan"), False)
    while essential.sum() > 1:
        relative = np.divide(100 * std, np.abs(beta), out=np.full(b, np.inf), where=beta != 0)
        relative[~essential] = -1.0
        weakest = int(np.argmax(relative))
        if relative[weakest] <= ESSENTIAL_PERCENT:
            break
        essential[weakest] = False
        solution = system.solve(essential)
        beta, std = solution.beta, solution.std
        dropped = int(b - essential.sum())
        F = (solution.rest - full) / full * freedom / dropped
        limit = float(stats.f.ppf(1 - LEVEL, dropped, freedom))
        if limit < F:
            return Reduction(
                result.essential, result.beta, result.std, result.F, result.F_limit, result.p_value, stopped_by_F=True
            )
        p_value = float(stats.f.sf(F, dropped, freedom))
        result = Reduction(essential.copy(), beta, std, float(F), limit, p_value, stopped_by_F=False)
    return result


def unshown(estimate: Estimate, reduction: Reduction) -> list[str]:
    """Which parameters this motion cannot show, in words: too small to matter, or not told apart from others."""
    out = []
    names, base = estimate.base.names, estimate.base
    std = np.sqrt(np.diag(estimate.covariance))
    correlation = estimate.covariance / np.outer(std, std)
    weak = ~reduction.essential
    for i, k in zip(*np.nonzero(np.triu(np.abs(correlation) > CONFUSED, 1)), strict=True):
        if weak[i] or weak[k]:
            out.append(
                f"This motion hardly tells {names[i]} from {names[k]} (correlation {correlation[i, k]:+.2f}): only a"
                " combination of them is known. Add poses in which they act differently."
            )
    if not weak.any():
        return out
    shown = ", ".join(f"{names[i]} {estimate.beta[i]:.3g} ± {std[i]:.2g} {base.units[i]}" for i in np.flatnonzero(weak))
    text = f"Not to be told from zero, or not needed, on this motion ({int(weak.sum())} of {len(names)}): {shown}."
    if estimate.system is not None:
        share = np.linalg.norm(estimate.system.W[:, weak] @ estimate.beta[weak]) / np.linalg.norm(estimate.system.y)
        text += f" Together they make {100 * share:.2g} % of the torques."
    return [*out, text]
