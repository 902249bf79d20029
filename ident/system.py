"""The weighted linear system of a fit, reduced to few rows: what any subset of its parameters would give."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Array = NDArray[np.float64]


class Solution(NamedTuple):
    """Values of a system.

    Attributes:
        beta: Zero where dropped, shape (b,).
        inverse: Square root of the covariance for errors of unit variance, C = inverse inverse', zero where dropped,
            shape (b, b).
        rest: Squared norm of the residual.
    """

    beta: Array
    inverse: Array
    rest: float

    @property
    def std(self) -> Array:
        """Standard deviations for errors of unit variance, shape (b,)."""
        return np.asarray(np.linalg.norm(self.inverse, axis=1))


@dataclass(frozen=True)
class System:
    """Z' W beta = Z' y with rows weighted to errors of unit variance and reduced by an orthogonal transformation.

    Attributes:
        W: shape (k, b).
        y: shape (k,).
        Z: Instruments, shape (k, b); None for least squares, where they are W.
    """

    W: Array
    y: Array
    Z: Array | None = None

    @classmethod
    def of_triangle(cls, R: Array) -> "System":
        """Least squares on the triangle of QR([W y])."""
        return cls(R[:, :-1], R[:, -1])

    @classmethod
    def of_instruments(cls, R: Array, b: int) -> "System":
        """Instrumental variables on the triangle of QR([Z W y])."""
        return cls(R[:, b : 2 * b], R[:, 2 * b], R[:, :b])

    @property
    def instruments(self) -> Array:
        """Z, or W for least squares."""
        return self.W if self.Z is None else self.Z

    def solve(self, kept: NDArray[np.bool_] | None = None) -> Solution:
        """Solution with some parameters only, the others zero; covariance by eq. (8), for instruments inv(Z'Z).

        With fewer parameters than instruments, two-stage least squares: the values whose residual is least on the
        instruments. Only that part is added to `rest`. What errors of W in the dropped columns do to the whole residual
        says nothing of the parameters; for least squares both are the same.
        """
        b = self.W.shape[1]
        kept = np.ones(b, dtype=bool) if kept is None else kept
        Q, R = linalg.qr(self.instruments, mode="economic", check_finite=False)
        A, c = (R if self.Z is None else Q.T @ self.W), Q.T @ self.y
        q, r = linalg.qr(A[:, kept], mode="economic", check_finite=False)
        beta, inverse = np.zeros(b), np.zeros((b, b))
        beta[kept] = linalg.solve_triangular(r, q.T @ c)
        root = linalg.qr(R[:, kept], mode="r", check_finite=False)[0][: kept.sum()]
        inverse[np.ix_(kept, kept)] = linalg.solve_triangular(root, np.eye(len(root)))
        whole = beta if kept.all() else linalg.solve(A, c)
        rest = float(np.sum((self.y - self.W @ whole) ** 2) + np.sum((c - A @ beta) ** 2))
        return Solution(beta, inverse, rest)


def triangle(blocks: Sequence[Array]) -> Array:
    """R of the QR decomposition of stacked rows, shape (c, c); blocks may themselves be such triangles."""
    rows = np.vstack(blocks)
    columns = rows.shape[1]
    if len(rows) < columns:
        rows = np.vstack([rows, np.zeros((columns - len(rows), columns))])
    return np.asarray(linalg.qr(rows, mode="r", check_finite=False)[0][:columns])
