"""Tests after a fit. Each says its null in words, and either a statistic with its p-value or why it does not apply."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from ident.contract import Statistic
from ident.estimate import Estimate
from ident.observation import Observation
from ident.reduction import ESSENTIAL_PERCENT, Reduction

Array = NDArray[np.float64]

LEVEL = 0.05
ORDER = 5  # lags of the residual regression, eq. (28)
FEW = 50  # residuals below which no test is made
INDEPENDENT_R2 = 0.1  # paper, IV.B.2


def statistics(estimate: Estimate, observations: Sequence[Observation], reduction: Reduction) -> list[Statistic]:
    """Kolmogorov-Smirnov, Lilliefors, residual regression, Ljung-Box and F."""
    stretches = [run for joint in normalised_residuals(estimate, observations) for run in joint]
    values = np.concatenate(stretches) if stretches else np.empty(0)
    return [
        _kolmogorov(values),
        _lilliefors(values),
        _regression(stretches),
        _ljung_box(stretches),
        _f_statistic(estimate, reduction),
    ]


def normalised_residuals(estimate: Estimate, observations: Sequence[Observation]) -> list[list[Array]]:
    """rho_j / sigma_j (eq. (7)) of every joint: its unbroken runs of used rows."""
    out: list[list[Array]] = [[] for _ in estimate.sigma_Nm]
    for o in observations:
        residual = (o.y - o.predict(estimate.beta)) / estimate.sigma_Nm[:, None]
        for j, joint in enumerate(out):
            rows = np.flatnonzero(o.used[j])
            breaks = np.flatnonzero((np.diff(rows) > 1) | o.first[rows[1:]]) + 1
            joint += [residual[j, run] for run in np.split(rows, breaks) if run.size]
    return out


def _kolmogorov(values: Array) -> Statistic:
    null = "normalised residuals are standard normal, N(0, 1)"
    if values.size < FEW:
        return Statistic("Kolmogorov-Smirnov", null, not_applicable=f"only {values.size} residuals")
    test = stats.kstest(values, "norm")
    return _verdict("Kolmogorov-Smirnov", null, float(test.statistic), float(test.pvalue))


def _lilliefors(values: Array) -> Statistic:
    """P-value by the approximation of Dallal & Wilkinson 1986 (American Statistician 40, 294-296), good below 0.1."""
    name, null = "Lilliefors", "normalised residuals are normal, mean and variance estimated"
    if values.size < FEW or values.std() == 0:
        return Statistic(name, null, not_applicable=f"only {values.size} residuals")
    D = float(stats.kstest((values - values.mean()) / values.std(ddof=1), "norm").statistic)
    scaled, n = (D, values.size) if values.size <= 100 else (D * (values.size / 100) ** 0.49, 100)
    exponent = -7.01256 * scaled**2 * (n + 2.78019) + 2.99587 * scaled * np.sqrt(n + 2.78019)
    p_value = float(np.exp(exponent - 0.122119 + 0.974598 / np.sqrt(n) + 1.67997 / n))
    return _verdict(name, null, D, min(p_value, 1.0))


def _regression(stretches: Sequence[Array]) -> Statistic:
    """Eq. (28)-(30), adjusted for the number of regressors: the raw R2 is large under the null with few rows."""
    name, null = "residual autoregression R2", f"residuals do not depend on the {ORDER} before them"
    long = [s for s in stretches if s.size > ORDER + 1]
    if sum(s.size - ORDER for s in long) < FEW:
        return Statistic(name, null, not_applicable=f"unbroken runs of more than {ORDER + 1} residuals are too few")
    lagged = np.vstack([np.column_stack([s[ORDER - k : s.size - k] for k in range(1, ORDER + 1)]) for s in long])
    value = np.concatenate([s[ORDER:] for s in long])
    rest = value - lagged @ np.linalg.lstsq(lagged, value, rcond=None)[0]
    n = value.size
    R2 = 1 - float(rest @ rest / (value @ value)) * n / (n - ORDER)
    F = (float(value @ value) - float(rest @ rest)) / ORDER / (float(rest @ rest) / (n - ORDER))
    verdict = "accepted" if R2 < INDEPENDENT_R2 else "rejected"
    return Statistic(name, null, statistic=R2, p_value=float(stats.f.sf(F, ORDER, n - ORDER)), verdict=verdict)


def _ljung_box(stretches: Sequence[Array]) -> Statistic:
    name, null = "Ljung-Box", f"residuals are uncorrelated up to lag {ORDER}"
    n = sum(s.size for s in stretches)
    if n < FEW:
        return Statistic(name, null, not_applicable=f"only {n} residuals")
    square = sum(float(s @ s) for s in stretches)
    Q = 0.0
    for lag in range(1, ORDER + 1):
        pairs = sum(max(0, s.size - lag) for s in stretches)
        if pairs:
            r = sum(float(s[lag:] @ s[:-lag]) for s in stretches if s.size > lag) / square * n / pairs
            Q += pairs * r**2
    return _verdict(name, null, Q, float(stats.chi2.sf(Q, ORDER)))


def _f_statistic(estimate: Estimate, reduction: Reduction) -> Statistic:
    dropped = int((~reduction.essential).sum())
    name = "F, model reduction"
    if dropped == 0:
        reason = f"no parameter above {ESSENTIAL_PERCENT:g} % relative deviation could be dropped"
        return Statistic(name, "the dropped parameters are zero", not_applicable=reason)
    null = f"the {dropped} of {len(estimate.beta)} base parameters that were dropped are zero"
    return Statistic(name, null, statistic=reduction.F, p_value=reduction.p_value, verdict="accepted")


def _verdict(name: str, null: str, statistic: float, p_value: float) -> Statistic:
    verdict = "accepted" if p_value >= LEVEL else "rejected"
    return Statistic(name, null, statistic=statistic, p_value=p_value, verdict=verdict)
