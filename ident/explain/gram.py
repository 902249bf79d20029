"""Scores of many candidate columns at once: gain in likelihood on motion held out, less what it costs to believe."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Array = NDArray[np.float64]

FLOOR = 0.5  # share of the expected residual below which a residual counts as noise
RIDGE = 1e-9  # of a candidate's own Gram block: columns that the base explains stay solvable


@dataclass(frozen=True)
class Scores:
    """Of G candidates with m columns each, for each of D torque vectors.

    Attributes:
        gain: Held-out log-likelihood gain plus prior surprise removed, shape (G, D) [nats].
        held_out: The first part alone.
        c: Coefficients fitted to everything, shape (G, m, D).
        std: Of them, shape (G, m).
    """

    gain: Array
    held_out: Array
    c: Array
    std: Array


class Stage:
    """A base model, possibly with effects already accepted, against which candidates compete.

    Args:
        W: Weighted columns per joint, shape (n_j, p).
        Y: Weighted torque per joint, shape (n_j, D).
        fold: Of each row, per joint.
        counted: Rows that are judged, per joint.
        independent: Share of the rows that is independent.
        precision: Of the prior on each column, shape (p,).
    """

    def __init__(
        self,
        W: Sequence[Array],
        Y: Sequence[Array],
        fold: Sequence[NDArray[np.int64]],
        counted: Sequence[NDArray[np.bool_]],
        independent: float,
        precision: Array,
    ) -> None:
        self.W, self.Y, self.precision = list(W), list(Y), precision
        self.folds = sorted(set(np.concatenate(fold).tolist()))
        self.test = [[np.flatnonzero(f == k) for f in fold] for k in self.folds]
        J = len(self.W)
        gram = [[self.W[j][rows[j]].T @ self.W[j][rows[j]] for j in range(J)] for rows in self.test]
        cross = [[self.W[j][rows[j]].T @ self.Y[j][rows[j]] for j in range(J)] for rows in self.test]
        self._gram_fold = [_sum(g) for g in gram]
        A = _sum(self._gram_fold) + np.diag(precision)
        b = _sum([_sum(c) for c in cross])
        self._factor = linalg.cho_factor(A, lower=True)
        self.phi = linalg.cho_solve(self._factor, b)
        self._gram = gram
        self._factors, self._left, self._rss, self._count, self._cross_left = [], [], [], [], []
        for k, rows in enumerate(self.test):
            factor = linalg.cho_factor(A - self._gram_fold[k], lower=True)
            phi = linalg.cho_solve(factor, b - _sum(cross[k]))
            self._factors.append(factor)
            left_test = [self.Y[j][rows[j]] - self.W[j][rows[j]] @ phi for j in range(J)]
            self._left.append([self.Y[j] - self.W[j] @ phi for j in range(J)])
            self._rss.append([(r**2).sum(axis=0) for r in left_test])
            self._count.append([independent * counted[j][rows[j]].sum() for j in range(J)])
            self._cross_left.append([self.W[j][rows[j]].T @ r for j, r in enumerate(left_test)])
        self._independent = independent

    def residual(self, joint: int) -> Array:
        """Of the fit to everything, weighted, shape (n_j, D)."""
        return np.asarray(self.Y[joint] - self.W[joint] @ self.phi)

    def covariance(self) -> Array:
        """Posterior covariance of the columns' coefficients at noise level, shape (p, p)."""
        return np.asarray(linalg.cho_solve(self._factor, np.eye(len(self.precision)))) / self._independent

    def score(self, columns: Mapping[int, Array]) -> Scores:
        """Scores of candidates.

        Args:
            columns: By joint, weighted rows of shape (n_j, G, m); joints left out see nothing of the candidates.
        """
        _, G, m = next(iter(columns.values())).shape
        flat = {j: np.ascontiguousarray(c.reshape(len(c), G * m)) for j, c in columns.items()}
        D = self.Y[0].shape[1]
        WC = [{j: self.W[j][rows[j]].T @ c[rows[j]] for j, c in flat.items()} for rows in self.test]
        CC = [{j: _blocks(c[rows[j]], c[rows[j]], G, m) for j, c in flat.items()} for rows in self.test]
        WC_all = _sum([_sum(part.values()) for part in WC])
        CC_all = _sum([_sum(part.values()) for part in CC])
        V = linalg.cho_solve(self._factor, WC_all)
        S = _ridged(CC_all - _blocks(WC_all, V, G, m))
        g = _sum([c.T @ self.residual(j) for j, c in flat.items()]).reshape(G, m, D)
        inverse = np.linalg.inv(S)
        c_all = inverse @ g
        phi_V = (self.phi * self.precision[:, None]).T @ V  # (D, G m)
        VV = _blocks(V * self.precision[:, None], V, G, m)
        surprise = np.einsum("dgm,gmd->gd", phi_V.reshape(D, G, m), c_all)
        surprise -= 0.5 * np.einsum("gmd,gmk,gkd->gd", c_all, VV, c_all)
        gain = np.zeros((G, D))
        for k, rows in enumerate(self.test):
            gain += self._fold_gain(k, rows, flat, WC_all - _sum(WC[k].values()), CC_all - _sum(CC[k].values()), CC[k])
        std = np.sqrt(np.maximum(np.einsum("gmm->gm", inverse), 0.0))
        return Scores(gain + surprise, gain, c_all, std)

    def _fold_gain(
        self,
        k: int,
        rows: Sequence[NDArray[np.int64]],
        flat: Mapping[int, Array],
        WC: Array,
        CC: Array,
        CC_test: Mapping[int, Array],
    ) -> Array:
        """Held-out gain of one fold, shape (G, D)."""
        G, m = CC.shape[:2]
        D = self.Y[0].shape[1]
        V = linalg.cho_solve(self._factors[k], WC)
        S = _ridged(CC - _blocks(WC, V, G, m))
        g = np.zeros((G * m, D))
        for j, c in flat.items():
            left = self._left[k][j].copy()
            left[rows[j]] = 0.0
            g += c.T @ left
        c_hat = np.linalg.solve(S, g.reshape(G, m, D))
        gain = np.zeros((G, D))
        for j in range(len(self.W)):
            count = self._count[k][j]
            if count <= 0:
                continue
            rss0 = self._rss[k][j] * self._independent
            if j in flat:
                U = flat[j][rows[j]] - self.W[j][rows[j]] @ V
                Ur = (U.T @ (self._left[k][j][rows[j]])).reshape(G, m, D)
                UU = _blocks(U, U, G, m)
            else:
                Ur = -(V.T @ self._cross_left[k][j]).reshape(G, m, D)
                UU = _blocks(V, self._gram[k][j] @ V, G, m)
            change = -2 * np.einsum("gmd,gmd->gd", c_hat, Ur) + np.einsum("gmd,gmk,gkd->gd", c_hat, UU, c_hat)
            rss = rss0 + change * self._independent
            gain += 0.5 * count * np.log(np.maximum(rss0, FLOOR * count) / np.maximum(rss, FLOOR * count))
        return gain


def _sum(arrays: Iterable[Array]) -> Array:
    return np.asarray(np.sum(list(arrays), axis=0))


def _blocks(a: Array, b: Array, G: int, m: int) -> Array:
    """Diagonal blocks of a' b: shape (G, m, m)."""
    n = len(a)
    if G == 1:
        return (a.T @ b)[None]
    return np.asarray(np.einsum("ngi,ngk->gik", a.reshape(n, G, m), b.reshape(n, G, m)))


def _ridged(S: Array) -> Array:
    """With a ridge that keeps columns the base explains entirely from blowing up."""
    size = np.einsum("gmm->gm", S)
    m = S.shape[1]
    ridge = RIDGE * np.maximum(size, 0.0) + 1e-12
    return np.asarray(S + ridge[:, :, None] * np.eye(m))
