"""IDIM-IV: instrumental variables from the simulated arm (Janot, Vandanjon & Gautier 2014, III).

Each iteration simulates the auxiliary model at the last estimate, its control law scaled to the simulated inertia (22),
makes the instruments Z from the simulated motion exactly as W is made from the measured one, and solves
Z' W beta = Z' Y with every joint weighted (25). The start is an arm of rotors alone (24), so nothing has to be known.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ident.covariance import HAC, Covariance, Moments
from ident.estimate import Estimate, assemble, joint_rows, refuse_deficient
from ident.hausman import hausman
from ident.iteration import PAPER, Criterion, Outcome, Step, iterate
from ident.observation import Observation
from ident.problem import Problem
from ident.system import System, triangle

Array = NDArray[np.float64]

SHOWN = 1e-5  # singular value, columns scaled to 1, from which on the rows of one joint show a combination
AGREE = 2.0  # standard deviations between least squares and instrumental variables that chance brings about
ROUNDING = 1e-6  # share of the largest column: smaller ones are zero but for differences of rounded positions


@dataclass(frozen=True)
class IdimIv:
    """IDIM-IV.

    Attributes:
        covariance: How the standard deviations are made.
        criterion: Convergence.
        update_gains: Eq. (22). Without, the law is the recorded one, and far starts may not be simulable.
    """

    covariance: Covariance = HAC
    criterion: Criterion = PAPER
    update_gains: bool = True
    name: str = "IDIM-IV"

    def fit(self, problem: Problem) -> Estimate:
        """Instrumental variables from the regular initialisation.

        Raises:
            DataError: The reference trajectory is not known.
            ConfigError: The control law is not known.
            IdentificationError: The motion does not show some base parameters, or the auxiliary model cannot be
                simulated at some iteration; says which and what to do.
        """
        refuse_deficient(triangle(problem.triangles)[:, :-1], problem.base, problem.observations)

        def solve(columns: list[Observation]) -> Step:
            system, sigma = weighted_system(problem.observations, columns)
            refuse_deficient(system.instruments, problem.base, columns)
            return Step(problem.observations, system, sigma)

        found = iterate(problem, self.name, solve, self.criterion, update_gains=self.update_gains)
        moments = _moments(problem.observations, found)
        covariance, words = self.covariance.of(moments)
        std = np.sqrt(np.diag(covariance))
        least_squares = System(found.step.system.W, found.step.system.y).solve().beta
        return assemble(
            problem.observations,
            problem.base,
            self.name,
            found.beta,
            covariance=covariance,
            covariance_name=words,
            white=moments.white,
            sigma_Nm=found.step.sigma,
            system=found.step.system,
            triangles=problem.triangles,
            notes=[*found.notes, _difference(found.beta, least_squares, std, problem.base.names)],
            iterations=found.iterations,
            converged=found.converged,
            history=found.history,
            tests=[hausman(problem.observations, found.columns, found.step.sigma)],
        )


def _difference(beta: Array, least_squares: Array, std: Array, names: Sequence[str]) -> str:
    """Whether it matters: the Durbin-Wu-Hausman test finds correlations far too small to shift an estimate."""
    away = np.abs(least_squares - beta) / np.maximum(std, np.finfo(float).tiny)
    worst = int(np.argmax(away))
    says = "so either may be used" if away[worst] < AGREE else "so least squares is biased on these rows"
    return (
        f"Weighted least squares on the same rows differs from IDIM-IV by up to {away[worst]:.1f} standard deviations"
        f" ({names[worst]} {least_squares[worst]:.4g} for {beta[worst]:.4g}), {says}."
    )


def weighted_system(observations: Sequence[Observation], instruments: Sequence[Observation]) -> tuple[System, Array]:
    """System of (25), every joint weighted by the deviation of its own sub-system; and those deviations, shape (J,)."""
    b = observations[0].W.shape[2]
    blocks = [
        triangle(
            [
                np.column_stack([z.W[j, o.used[j]], o.W[j, o.used[j]], o.y[j, o.used[j]]])
                for o, z in zip(observations, instruments, strict=True)
            ]
        )
        for j in range(len(observations[0].joints))
    ]
    rows = joint_rows(observations)
    sigma = np.array([_joint_sigma(t, b, int(n)) for t, n in zip(blocks, rows, strict=True)])
    whole = triangle([t / s for t, s in zip(blocks, sigma, strict=True)])
    return System.of_instruments(whole, b), sigma


def _joint_sigma(block: Array, b: int, rows: int) -> float:
    """Standard deviation of one joint's error by instrumental variables on its own rows; parameters that they do not
    show are left out."""
    Z, W, y = block[:, :b], block[:, b : 2 * b], block[:, 2 * b]
    norms = np.linalg.norm(Z, axis=0)
    # a column may be zero in W alone: fc_m6 in rows of joint 6, where only the simulated motor turns the other way
    active = np.minimum(norms, np.linalg.norm(W, axis=0)) > ROUNDING * norms.max(initial=0.0)
    if rows == 0 or not active.any():
        return 1.0  # no rows to weight
    scale = norms[active]
    _, values, directions = np.linalg.svd(Z[:, active] / scale, full_matrices=False)
    shown = directions[values > SHOWN * values[0]].T
    Z, W = Z[:, active] / scale @ shown, W[:, active] / scale @ shown
    residual = y - W @ linalg.solve(Z.T @ W, Z.T @ y)
    sigma = float(np.linalg.norm(residual) / np.sqrt(max(1, rows - shown.shape[1])))
    return max(sigma, float(np.finfo(float).tiny))


def _moments(observations: Sequence[Observation], found: Outcome) -> Moments:
    """What any covariance needs: an error e moves the estimate by inv(Z' W) Z' e (weighted)."""
    system = found.step.system
    bread = np.asarray(np.linalg.inv(system.instruments.T @ system.W), dtype=np.float64)
    G = [
        np.where(o.used[:, :, None], z.W, 0.0) / found.step.sigma[:, None, None] ** 2
        for o, z in zip(observations, found.columns, strict=True)
    ]
    return Moments(observations, found.beta, bread, G, found.solution.inverse @ found.solution.inverse.T)
