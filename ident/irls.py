"""IDIM-IRLS: weighted least squares in which rows far outside count less (Huber 1964; Holland & Welsch 1977)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ident.covariance import HAC, Covariance, Moments
from ident.estimate import Estimate, assemble, joint_rows, joint_sigma, refuse_deficient
from ident.observation import Observation
from ident.problem import Problem
from ident.system import System, triangle
from protocols.errors import IdentificationError

Array = NDArray[np.float64]

TUNING = {"huber": 1.345, "bisquare": 4.685}  # 95 % efficiency under normal errors, in robust standard deviations
NORMAL_MAD = 0.6745  # median of |x| for a standard normal x
TOLERANCE = 1e-6  # of every parameter's standard deviation
ITERATIONS = 100
TOO_MANY = 0.25  # share of down-weighted rows (weight below one half) that is no longer a matter of outliers
SMALLEST = 1e-12  # of the torque's own size, a scale below which there is no error to weight


@dataclass(frozen=True)
class IterativelyReweighted:
    """IDIM-IRLS with a scale per joint (median absolute residual, renewed in every iteration).

    Attributes:
        loss: `huber` has one minimum; `bisquare` gives gross errors no weight at all and starts from `huber`.
        covariance: How the standard deviations are made.
    """

    loss: Literal["huber", "bisquare"] = "huber"
    covariance: Covariance = HAC

    @property
    def name(self) -> str:
        return "IDIM-IRLS"

    def fit(self, problem: Problem) -> Estimate:
        """Iterate weights and least squares.

        Raises:
            IdentificationError: The motion does not show some base parameters, or no convergence.
        """
        observations, base = problem.observations, problem.base
        refuse_deficient(triangle(problem.triangles)[:, :-1], base, observations)
        sigma = joint_sigma(problem.triangles, joint_rows(observations))
        beta = System.of_triangle(triangle([t / s for t, s in zip(problem.triangles, sigma, strict=True)])).solve().beta
        iterations = 0
        for loss in ("huber",) if self.loss == "huber" else ("huber", "bisquare"):
            beta, scale, weights, system, steps = _iterate(observations, beta, loss)
            iterations += steps
        moments = _moments(observations, beta, scale, weights, self.loss)
        covariance, words = self.covariance.of(moments)
        return assemble(
            observations,
            base,
            self.name,
            beta,
            covariance=covariance,
            covariance_name=words,
            white=moments.white,
            sigma_Nm=scale,
            system=system,
            triangles=problem.triangles,
            notes=_outliers(observations, weights),
            iterations=iterations,
        )


def _iterate(
    observations: Sequence[Observation], beta: Array, loss: str
) -> tuple[Array, Array, list[Array], System, int]:
    """Values, scales, weights, the last weighted system and the number of iterations of one loss."""
    for iteration in range(ITERATIONS):
        scale = robust_scale(observations, beta)
        weights = [weight(_normalised(o, beta, scale), loss) for o in observations]
        rows = [
            np.column_stack([o.W[j, o.used[j]], o.y[j, o.used[j]]]) * (np.sqrt(w[j, o.used[j]]) / scale[j])[:, None]
            for o, w in zip(observations, weights, strict=True)
            for j in range(len(scale))
        ]
        system = System.of_triangle(triangle(rows))
        solution = system.solve()
        step = float(np.max(np.abs(solution.beta - beta) / solution.std))
        beta = solution.beta
        if step < TOLERANCE:
            return beta, scale, weights, system, iteration + 1
    raise IdentificationError(
        f"IDIM-IRLS ({loss}) still moves by {step:.1g} standard deviations after {ITERATIONS} iterations. Look at the"
        " residuals for a change in the middle of the recording, or use wls."
    )


def robust_scale(observations: Sequence[Observation], beta: Array) -> Array:
    """Standard deviation of every joint's error by the median of its absolute residuals, shape (J,) [N·m]."""
    out = []
    for j in range(len(observations[0].joints)):
        r = np.concatenate([np.abs(o.y[j] - o.W[j] @ beta)[o.used[j]] for o in observations])
        size = np.concatenate([np.abs(o.y[j])[o.used[j]] for o in observations])
        floor = max(SMALLEST * float(size.max(initial=0.0)), float(np.finfo(float).tiny))
        out.append(max(float(np.median(r)) / NORMAL_MAD, floor) if r.size else 1.0)
    return np.array(out)


def weight(u: Array, loss: str) -> Array:
    """psi(u) / u of normalised residuals."""
    c = TUNING[loss]
    if loss == "huber":
        return np.asarray(c / np.maximum(np.abs(u), c))
    return np.asarray(np.where(np.abs(u) < c, (1 - (u / c) ** 2) ** 2, 0.0))


def _slope(u: Array, loss: str) -> Array:
    """Derivative of psi."""
    c = TUNING[loss]
    if loss == "huber":
        return np.asarray(np.abs(u) <= c, dtype=float)
    v = (u / c) ** 2
    return np.asarray(np.where(v < 1, (1 - v) * (1 - 5 * v), 0.0))


def _normalised(o: Observation, beta: Array, scale: Array) -> Array:
    return np.asarray((o.y - o.predict(beta)) / scale[:, None])


def _moments(
    observations: Sequence[Observation], beta: Array, scale: Array, weights: Sequence[Array], loss: str
) -> Moments:
    """Of an M-estimate: bread from the slope of psi, scores from psi itself (Huber 1981, 7.6)."""
    b = len(beta)
    bend, score = np.zeros((b, b)), np.zeros((b, b))
    G = []
    for o, w in zip(observations, weights, strict=True):
        u = _normalised(o, beta, scale)
        for j, s in enumerate(scale):
            slope = np.where(o.used[j], _slope(u[j], loss), 0.0)
            psi = np.where(o.used[j], w[j] * u[j], 0.0)
            bend += (o.W[j] * (slope / s**2)[:, None]).T @ o.W[j]
            score += (o.W[j] * ((psi / s) ** 2)[:, None]).T @ o.W[j]
        G.append(np.where(o.used, w, 0.0)[:, :, None] * o.W / scale[:, None, None] ** 2)
    bread = np.asarray(np.linalg.inv(bend), dtype=float)
    return Moments(observations, beta, bread, G, bread @ score @ bread)


def _outliers(observations: Sequence[Observation], weights: Sequence[Array]) -> list[str]:
    low = np.array([sum(int(((w < 0.5) & o.used)[j].sum()) for o, w in zip(observations, weights, strict=True))
                    for j in range(len(observations[0].joints))])  # fmt: skip
    share = low / np.maximum(joint_rows(observations), 1)
    if not low.any():
        return []
    names = observations[0].joints
    shares = ", ".join(f"{name} {100 * s:.1f} %" for name, s in zip(names, share, strict=True) if s > 0)
    notes = [f"Rows whose weight fell below one half: {shares}."]
    if share.max() > TOO_MANY:
        worst = names[int(np.argmax(share))]
        notes.append(
            f"{worst}: {100 * share.max():.0f} % of the rows are outside; that is not a few bad rows but something the"
            " model lacks. Look at the residuals over time and speed."
        )
    return notes
