"""Maximum likelihood with noise on positions and torques (Olsen & Petersen 2001; Olsen, Swevers & Verdonck 2002).

As eq. (13)-(16) of Bona & Curatella: the measured x = (q, dq, ddq) of every row differs from the true one by noise of
known covariance, and so does the torque. To first order the row's error b = tau - W(x) theta then has the covariance
S² = B C B' + T, with B the derivative of the modelled torque with respect to x, C the covariance of x and T that of
the torque, and theta minimises sum of b' inv(S²) b. S depends on theta: that is what makes it more than weighted
least squares, and what takes out the bias of noisy columns, to first order.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.covariance import HAC, Covariance, Moments
from ident.estimate import Estimate, assemble, joint_rows, joint_sigma, refuse_deficient
from ident.observation import Observation
from ident.positionnoise import States, columns, position_noise, signs, state_covariance, states, torque_slopes
from ident.problem import Problem
from ident.system import System, triangle
from protocols.errors import IdentificationError

Array = NDArray[np.float64]

ITERATIONS = 60
TOLERANCE = 1e-5  # of every parameter's standard deviation
SMALLEST_SHARE = 1e-3  # of a joint's squared residual that is taken as torque noise at least


@dataclass(frozen=True)
class MaximumLikelihood:
    """ML with independent noise on every joint's position and torque.

    Attributes:
        position_noise_rad: Standard deviation of the measured joint positions, one for all joints; None to estimate it
            from the sixth differences of the recorded positions.
        covariance: How the standard deviations are made; `white` is eq. (16).
    """

    position_noise_rad: float | None = None
    covariance: Covariance = HAC

    @property
    def name(self) -> str:
        return "ML"

    def fit(self, problem: Problem) -> Estimate:
        """Gauss-Newton from IDIM-WLS; the torque noise of every joint is estimated along.

        Raises:
            IdentificationError: The motion does not show some base parameters, or no convergence.
        """
        observations, base = problem.observations, problem.base
        refuse_deficient(triangle(problem.triangles)[:, :-1], base, observations)
        sigma = joint_sigma(problem.triangles, joint_rows(observations))
        beta = System.of_triangle(triangle([t / s for t, s in zip(problem.triangles, sigma, strict=True)])).solve().beta
        runs = []
        for signals, dataset, o in zip(problem.signals, problem.datasets, observations, strict=True):
            noise = position_noise(signals.q) if self.position_noise_rad is None else self.position_noise_rad
            runs.append(_Run(problem, o, states(dataset, o), noise**2 * state_covariance(dataset, o), noise))
        torque, iterations = sigma.copy(), 0
        for _ in range(ITERATIONS):
            iterations += 1
            pieces = [run.error_covariance(beta, torque) for run in runs]
            torque = _torque_noise(runs, pieces, beta, torque)
            whitened = [run.corrected(beta, *piece) for run, piece in zip(runs, pieces, strict=True)]
            normal = sum(np.einsum("jnb,jnc->bc", G, W) for G, W, _ in whitened)
            score = sum(np.einsum("jnb,jn->b", G, r) for G, _, r in whitened)
            bread = np.asarray(np.linalg.inv(normal), dtype=float)
            step = bread @ score
            beta = beta + step
            if np.max(np.abs(step) / np.sqrt(np.diag(bread))) < TOLERANCE:
                break
        else:
            worst = base.names[int(np.argmax(np.abs(step) / np.sqrt(np.diag(bread))))]
            raise IdentificationError(
                f"ML still moves {worst} by {np.max(np.abs(step) / np.sqrt(np.diag(bread))):.1g} standard deviations"
                f" after {ITERATIONS} iterations. Filter the positions more, give the position noise, or use iv."
            )
        moments = Moments(observations, beta, bread, [G for G, _, _ in whitened], bread)
        covariance, words = self.covariance.of(moments)
        taken = ", ".join(f"{1e6 * run.position_noise:.2g} urad" for run in runs)
        return assemble(
            observations,
            base,
            self.name,
            beta,
            covariance=covariance,
            covariance_name=words,
            white=bread,
            sigma_Nm=torque,
            triangles=problem.triangles,
            notes=[f"Position noise taken: {taken}; torque noise is what remains of the residual."],
            iterations=iterations,
        )


@dataclass(frozen=True)
class _Run:
    """One recording.

    Attributes:
        problem: Model and base.
        o: Its rows.
        x: States at the rows.
        C: Covariance of the rows' (q, dq, ddq) of one joint, the same for all, shape (3, 3).
        position_noise: Standard deviation of the recorded positions [rad].
    """

    problem: Problem
    o: Observation
    x: States
    C: Array
    position_noise: float

    def error_covariance(self, beta: Array, torque: Array) -> tuple[Array, Array]:
        """C B' per row, shape (N, 3 J, J), and B C B' + T, shape (N, J, J); identity in rows not used."""
        B = torque_slopes(self.problem, self.x, beta)
        CB = np.kron(np.eye(len(torque)), self.C) @ np.swapaxes(B, 1, 2)
        mask = self.o.used.T
        V = np.where(mask[:, :, None] & mask[:, None, :], B @ CB + np.diag(torque**2), np.eye(len(torque)))
        return CB, V

    def corrected(self, beta: Array, CB: Array, V: Array) -> tuple[Array, Array, Array]:
        """Weighted columns at the most likely states, shape (J, N, b); those columns unweighted; residuals (J, N).

        The derivative of b' inv(S²) b / 2 is -(W + dW)' inv(S²) b, with dW the columns' change at the state that
        explains part of the error, x + C B' inv(S²) b.
        """
        r = np.where(self.o.used, self.o.y - self.o.predict(beta), 0.0)
        shift = np.einsum("nxj,nj->nx", CB, np.linalg.solve(V, r.T[:, :, None])[:, :, 0])
        likely = States(*(v + shift[:, kind::3] for kind, v in enumerate(self.x)))
        change = columns(self.problem, likely) - columns(self.problem, self.x)
        W = np.where(self.o.used[:, :, None], self.o.W + np.where(signs(self.problem), 0.0, change), 0.0)
        G = np.moveaxis(np.linalg.solve(V, np.moveaxis(W, 0, 1)), 1, 0)
        return np.where(self.o.used[:, :, None], G, 0.0), W, r


def _torque_noise(runs: Sequence[_Run], pieces: Sequence[tuple[Array, Array]], beta: Array, torque: Array) -> Array:
    """Per joint such that the residuals have the variance they should, shape (J,) [N·m]."""
    square, expected, rows = np.zeros(len(torque)), np.zeros(len(torque)), np.zeros(len(torque))
    for run, (_, V) in zip(runs, pieces, strict=True):
        r = np.where(run.o.used, run.o.y - run.o.predict(beta), 0.0)
        square += (r**2).sum(axis=1)
        columns_share = np.diagonal(V, axis1=1, axis2=2).T - torque[:, None] ** 2
        expected += np.where(run.o.used, columns_share, 0.0).sum(axis=1)
        rows += run.o.used.sum(axis=1)
    rows = np.maximum(rows, 1)
    return np.asarray(np.sqrt(np.maximum((square - expected) / rows, SMALLEST_SHARE * square / rows)))
