"""Durbin-Wu-Hausman: may least squares be trusted, or are the columns correlated with the errors?

As an augmented regression (Davidson & MacKinnon 1993, Estimation and Inference in Econometrics, 7.9): under the null
the difference between instruments and columns explains nothing of what least squares leaves. That is the same test as
the distance between the two estimates in the metric of their covariances' difference, but that difference is nearly
singular where the two agree, and need not even be positive.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats

from ident.contract import Statistic
from ident.observation import Observation
from ident.system import triangle

Array = NDArray[np.float64]

LEVEL = 0.05
SAME = 1e-7  # share of a column by which instrument and column must differ to count as different
INDEPENDENT = 1e-6  # singular value, columns scaled to 1, from which on a difference is one of its own
NAME = "Durbin-Wu-Hausman"
NULL = "least squares and instrumental variables estimate the same: columns and errors are uncorrelated"


def hausman(observations: Sequence[Observation], instruments: Sequence[Observation], sigma: Array) -> Statistic:
    """The test, on rows weighted by the errors' deviations.

    Args:
        instruments: Rows of the simulated motion; only W is looked at.
        sigma: shape (J,).
    """
    b = observations[0].W.shape[2]
    R = triangle(
        [
            np.column_stack([o.W[j, o.used[j]], z.W[j, o.used[j]] - o.W[j, o.used[j]], o.y[j, o.used[j]]]) / sigma[j]
            for o, z in zip(observations, instruments, strict=True)
            for j in range(len(o.joints))
        ]
    )
    rows = sum(o.rows for o in observations)
    size = np.linalg.norm(R[:b, :b], axis=0)
    different = np.linalg.norm(R[:, b : 2 * b], axis=0) > SAME * size
    if not different.any():
        return Statistic(NAME, NULL, not_applicable="columns and instruments are the same")
    D = R[b:, b : 2 * b][:, different]  # what the columns do not explain
    norms = np.linalg.norm(D, axis=0)
    left, values, _ = linalg.svd(D / np.where(norms > 0, norms, 1.0), full_matrices=False)
    left = left[:, values > INDEPENDENT * values[0]]
    rest = R[b:, 2 * b]
    explained, k = float(np.sum((left.T @ rest) ** 2)), left.shape[1]
    freedom = rows - b - k
    if freedom < 1:
        return Statistic(NAME, NULL, not_applicable=f"{rows} rows are too few for {b} columns and {k} differences")
    F = explained / k / ((float(rest @ rest) - explained) / freedom)
    p_value = float(stats.f.sf(F, k, freedom))
    verdict = "accepted" if p_value >= LEVEL else "rejected"
    return Statistic(NAME, NULL, statistic=F, p_value=p_value, verdict=verdict)
