"""DIDIM, also known as CLIE: closed-loop input error, from torques and the reference alone.

Gautier, Vandanjon & Janot 2011 (ICRA, reference 27 of Janot, Vandanjon & Gautier 2014): the simulated arm follows the
same reference, so its own motion stands for the measured one, and the columns of the inverse model along it for the
derivative of its torque. Weighted least squares of the measured torque on them gives the next parameters. No position
is measured, filtered or differentiated.
"""

from dataclasses import dataclass, replace

from ident.covariance import HAC, Covariance, Moments
from ident.estimate import Estimate, assemble, joint_rows, joint_sigma, joint_triangles, refuse_deficient
from ident.iteration import PAPER, Criterion, Step, iterate
from ident.observation import Observation
from ident.problem import Problem
from ident.system import System, triangle


@dataclass(frozen=True)
class Didim:
    """DIDIM.

    Attributes:
        covariance: How the standard deviations are made.
        criterion: Convergence.
        update_gains: Eq. (22).
    """

    covariance: Covariance = HAC
    criterion: Criterion = PAPER
    update_gains: bool = True
    name: str = "DIDIM"

    def fit(self, problem: Problem) -> Estimate:
        """Gauss-Newton steps from the regular initialisation.

        Raises:
            DataError, ConfigError, IdentificationError: As `ident.iv.IdimIv.fit`.
        """

        def solve(columns: list[Observation]) -> Step:
            rows = [replace(z, y=o.y) for o, z in zip(problem.observations, columns, strict=True)]
            triangles = joint_triangles(rows)
            refuse_deficient(triangle(triangles)[:, :-1], problem.base, rows)
            sigma = joint_sigma(triangles, joint_rows(rows))
            return Step(
                rows, System.of_triangle(triangle([t / s for t, s in zip(triangles, sigma, strict=True)])), sigma
            )

        found = iterate(problem, self.name, solve, self.criterion, update_gains=self.update_gains)
        white = found.solution.inverse @ found.solution.inverse.T
        moments = Moments.weighted(found.step.rows, found.beta, found.step.sigma, white)
        covariance, words = self.covariance.of(moments)
        return assemble(
            problem.observations,
            problem.base,
            self.name,
            found.beta,
            covariance=covariance,
            covariance_name=words,
            white=white,
            sigma_Nm=found.step.sigma,
            system=found.step.system,
            triangles=problem.triangles,
            notes=found.notes,
            iterations=found.iterations,
            converged=found.converged,
            history=found.history,
        )
