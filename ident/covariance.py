"""Covariance that is honest when errors are correlated in time and between joints."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ident.observation import Observation

Array = NDArray[np.float64]


def hac(observations: Sequence[Observation], beta: Array, sigma: Array, inverse: Array) -> tuple[Array, int]:
    """Newey & West 1987 (Econometrica 55, 703-708): A S A with A = inv(W' W / sigma²), S the long-run covariance of
    the scores, Bartlett kernel.

    The score of an instant is the sum over joints of W_j' rho_j / sigma_j², so errors of different joints at one
    instant may correlate (a coupled motor's current enters two joint torques). Lags do not reach over gaps.

    Args:
        sigma: Weights 1/sigma_j of the estimate, shape (J,).
        inverse: inv(R) of the weighted triangle, A = inverse inverse', shape (b, b).

    Returns:
        Covariance, shape (b, b), and the number of lags.
    """
    b = len(beta)
    instants = sum(o.t_s.size for o in observations)
    lags = bandwidth(instants)
    S = np.zeros((b, b))
    for o in observations:
        weighted = np.where(o.used, o.y - o.predict(beta), 0.0) / sigma[:, None] ** 2
        scores = np.einsum("jn,jnb->nb", weighted, o.W)
        for stretch in np.split(scores, np.flatnonzero(o.first)[1:]):
            S += stretch.T @ stretch
            for lag in range(1, min(lags, len(stretch) - 1) + 1):
                product = stretch[lag:].T @ stretch[:-lag]
                S += (1 - lag / (lags + 1)) * (product + product.T)
    rows = sum(o.rows for o in observations)
    A = inverse @ inverse.T
    return A @ S @ A * rows / max(1, rows - b), lags


def bandwidth(instants: int) -> int:
    """Lags, growing as the cube root of the number of instants: the rate that suits the Bartlett kernel (Andrews
    1991, Econometrica 59, 817-858)."""
    return max(1, round(float(np.cbrt(instants))))
