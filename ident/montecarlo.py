"""Covariance by simulated errors: draw series like the residuals, pass them through the estimate, see the spread."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, signal

from ident.covariance import Moments
from ident.observation import Observation

Array = NDArray[np.float64]

ORDER = 4  # lags of the errors' autoregression: 80 ms at 50 Hz rows
SETTLE = 50  # drawn instants before those used: stationary to 1e-4 at a largest root of 0.83
DRAWS = 400  # standard deviations to 4 %
SEED = 20131101


@dataclass(frozen=True)
class MonteCarlo:
    """Spread of estimates from simulated errors: every joint's residual is an autoregression with normal innovations,
    those of one instant correlated between joints as found (sieve bootstrap, Bühlmann 1997, Bernoulli 3, 123-148).

    Errors of the torque only, passed through the linearised estimate; noise in the columns is not drawn anew.

    Attributes:
        draws: Number of simulated recordings.
        seed: Of the draws.
    """

    draws: int = DRAWS
    seed: int = SEED

    def of(self, moments: Moments) -> tuple[Array, str]:
        rng = np.random.default_rng(self.seed)
        residuals = moments.residuals
        models = [autoregression(_runs(moments.observations, residuals, j)) for j in range(residuals[0].shape[0])]
        root = innovation_root(moments.observations, residuals, models) * np.sqrt(moments.inflation)
        shifts = np.zeros((self.draws, len(moments.beta)))
        for draw in range(self.draws):
            for o, G in zip(moments.observations, moments.G, strict=True):
                innovations = root @ rng.normal(size=(len(models), o.t_s.size + SETTLE))
                for j, a in enumerate(models):
                    error = signal.lfilter([1.0], np.r_[1.0, -a], innovations[j])[SETTLE:]
                    shifts[draw] += error @ G[j]
        covariance = np.cov(shifts @ moments.bread.T, rowvar=False).reshape(len(moments.beta), -1)
        return covariance, f"Monte-Carlo ({self.draws} error series, autoregressive of order {ORDER}, seed {self.seed})"


def autoregression(runs: Sequence[Array]) -> Array:
    """Yule-Walker coefficients of one joint's unbroken residual runs, always stable, shape (ORDER,)."""
    square = sum(float(r @ r) for r in runs)
    if square == 0:
        return np.zeros(ORDER)
    c = np.array([sum(float(r[k:] @ r[: r.size - k]) for r in runs) for k in range(ORDER + 1)]) / square
    k = np.arange(ORDER)
    return np.asarray(np.linalg.solve(c[np.abs(k[:, None] - k)], c[1:]))


def innovation_root(observations: Sequence[Observation], residuals: Sequence[Array], models: Sequence[Array]) -> Array:
    """Square root of the innovations' covariance between joints, each from instants that have both, shape (J, J)."""
    J = len(models)
    product, count = np.zeros((J, J)), np.zeros((J, J))
    for o, residual in zip(observations, residuals, strict=True):
        value, known = np.zeros_like(residual), np.zeros_like(o.used)
        index = np.arange(ORDER, o.t_s.size)
        back = index[:, None] - np.arange(ORDER + 1)
        known[:, index] = o.used[:, back].all(axis=2) & ~o.first[back[:, :-1]].any(axis=1)
        for j, a in enumerate(models):
            value[j, index] = residual[j, index] - residual[j, back[:, 1:]] @ a
        value = np.where(known, value, 0.0)
        product += value @ value.T
        count += known.astype(float) @ known.T.astype(float)
    values, vectors = linalg.eigh(product / np.maximum(count, 1.0))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _runs(observations: Sequence[Observation], residuals: Sequence[Array], joint: int) -> list[Array]:
    """Unbroken runs of one joint's used residuals."""
    out: list[Array] = []
    for o, r in zip(observations, residuals, strict=True):
        rows = np.flatnonzero(o.used[joint])
        breaks = np.flatnonzero((np.diff(rows) > 1) | o.first[rows[1:]]) + 1
        out += [r[joint, run] for run in np.split(rows, breaks) if run.size]
    return out
