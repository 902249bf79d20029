"""IDIM-TLS: total least squares, in which columns carry errors as the torque does (Van Huffel & Vandewalle 1991)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ident.base import Base
from ident.covariance import HAC, Covariance, Moments
from ident.estimate import Estimate, assemble, joint_rows, joint_sigma, refuse_deficient
from ident.observation import Observation
from ident.positionnoise import column_errors
from ident.problem import Problem
from ident.system import triangle
from protocols.errors import IdentificationError

Array = NDArray[np.float64]

NEARLY_LOST = 0.95  # smallest singular value of [W y] over that of W, from where on the solution is noise


@dataclass(frozen=True)
class TotalLeastSquares:
    """IDIM-TLS: rows weighted by the standard deviation of their joint, columns by the covariance of their errors
    (generalised total least squares, Van Huffel & Vandewalle 1989, SIAM J. Matrix Anal. 10, 294-315).

    With a good filter it is least squares. Without, it corrects in the right direction and stays biased where
    instrumental variables are not (Janot et al. 2014, V.D): the weights come from residuals that hold the columns'
    errors already, and errors follow the motion.

    Attributes:
        errors: `position`: those that the recorded positions' noise leaves in the columns after filter, differences and
            decimation; offsets and signs of speeds are exact. `equal`: as large as the torque's and uncorrelated, but
            for exact offsets: the textbook's, which sixty parameters rarely survive.
        covariance: How the standard deviations are made.
    """

    errors: Literal["position", "equal"] = "position"
    covariance: Covariance = HAC

    @property
    def name(self) -> str:
        return "IDIM-TLS"

    def fit(self, problem: Problem) -> Estimate:
        """Total least squares over all rows used.

        Raises:
            IdentificationError: The motion does not show some base parameters, or shows them less than the errors.
        """
        observations, base = problem.observations, problem.base
        refuse_deficient(triangle(problem.triangles)[:, :-1], base, observations)
        sigma = joint_sigma(problem.triangles, joint_rows(observations))
        R = triangle([t / s for t, s in zip(problem.triangles, sigma, strict=True)])
        E = column_errors(problem, sigma) if self.errors == "position" else equal_errors(base)
        beta, smallest = solve(R, E)
        moments = _moments(observations, beta, sigma, R, E, smallest)
        covariance, words = self.covariance.of(moments)
        return assemble(
            observations,
            base,
            self.name,
            beta,
            covariance=covariance,
            covariance_name=words,
            white=moments.white,
            sigma_Nm=sigma,
            triangles=problem.triangles,
        )


def equal_errors(base: Base) -> Array:
    """Identity, zero for columns of ones, shape (b, b)."""
    return np.diag([0.0 if base.standard[k].startswith("offset") else 1.0 for k in base.kept])


def solve(R: Array, E: Array) -> tuple[Array, float]:
    """beta that minimises |R (beta, -1)|² / (1 + beta' E beta).

    Args:
        R: Triangle of QR([W y]), rows weighted to torque errors of variance 1, shape (b+1, b+1).
        E: Covariance of a row's column errors, shape (b, b), zero for exact columns.

    Returns:
        beta, shape (b,), and the minimum's square root: the smallest singular value of [W y] in the metric of E.

    Raises:
        IdentificationError: W is hardly further from rank deficiency than [W y] (non-generic problem).
    """
    b = len(E)
    root = np.zeros((b + 1, b + 1))
    values, vectors = linalg.eigh(E)
    root[:b, :b] = (vectors * np.sqrt(np.maximum(values, 0.0))).T
    root[b, b] = 1.0
    scale = np.linalg.norm(R, axis=0)
    scaled = R / scale
    if abs(scaled[b, b]) < np.finfo(float).eps:  # the torque is explained without a rest
        return np.asarray(linalg.solve_triangular(R[:b, :b], R[:b, b])), 0.0
    largest, rows = linalg.svd((root / scale) @ linalg.inv(scaled))[1:]
    alone = linalg.svdvals((root[:b, :b] / scale[:b]) @ linalg.inv(scaled[:b, :b]))[0]
    x = linalg.solve_triangular(scaled, rows[0]) / scale
    smallest = 1 / float(largest[0])
    if smallest * alone > NEARLY_LOST or x[b] == 0:
        raise IdentificationError(
            f"IDIM-TLS has no stable solution: the smallest singular value is {smallest:.3g} with the torque and"
            f" {1 / alone:.3g} without it, so the errors of the columns hide some parameters. Filter the positions"
            " more, record longer, or use iv."
        )
    return np.asarray(-x[:b] / x[b]), smallest


def _moments(
    observations: Sequence[Observation], beta: Array, sigma: Array, R: Array, E: Array, smallest: float
) -> Moments:
    """Stationarity: the sum over weighted rows of (w + r E beta / (1 + beta' E beta)) r is zero."""
    pull = E @ beta / (1 + beta @ E @ beta)
    bread = np.asarray(np.linalg.inv(R[:, :-1].T @ R[:, :-1] - smallest**2 * E), dtype=float)
    G = []
    score = np.zeros_like(bread)
    for o in observations:
        r = o.y - o.predict(beta)
        # rows are weighted by 1 / sigma and E is in those units, so r counts once weighted and once not
        corrected = o.W + r[:, :, None] * pull
        G.append(np.where(o.used[:, :, None], corrected, 0.0) / sigma[:, None, None] ** 2)
        flat = (G[-1] * r[:, :, None]).reshape(-1, len(beta))
        score += flat.T @ flat
    return Moments(observations, beta, bread, G, bread @ score @ bread)
