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

from ident import auxiliary
from ident.auxiliary import Run
from ident.contract import Iterate
from ident.covariance import HAC, Covariance, Moments
from ident.dataset import prepare
from ident.estimate import Estimate, assemble, joint_rows, refuse_deficient
from ident.hausman import hausman
from ident.model import Model
from ident.observation import Observation
from ident.problem import Problem
from ident.system import Solution, System, triangle
from protocols.errors import IdentificationError

Array = NDArray[np.float64]

SHOWN = 1e-5  # singular value, columns scaled to 1, from which on the rows of one joint show a combination
ROUNDING = 1e-6  # share of the largest column: smaller ones are zero but for differences of rounded positions


@dataclass(frozen=True)
class Criterion:
    """When an iteration has converged, eq. (27).

    A parameter has settled when it changes by less than `parameters` of its value or less than `deviations` of its
    standard deviation: one that the motion hardly shows never settles relatively to itself.

    Attributes:
        residual: tol1, relative change of the residual's norm.
        parameters: tol2, relative change of every parameter.
        deviations: Change in standard deviations that the data cannot tell.
        iterations: Most.
    """

    residual: float = 0.025
    parameters: float = 0.025
    deviations: float = 0.5
    iterations: int = 10

    def change(self, beta: Array, before: Array, std: Array) -> Array:
        """Of every parameter, in units of what is allowed, shape (b,)."""
        allowed = np.maximum(self.parameters * np.abs(before), self.deviations * std)
        return np.asarray(np.abs(beta - before) / np.maximum(allowed, np.finfo(float).tiny))

    def met(self, change: Array, norm: float, norm_before: float) -> bool:
        """Both parts; the first iteration has nothing to compare its residual with."""
        return bool(change.max() <= 1 and abs(norm - norm_before) <= self.residual * norm_before)

    def complaint(self, method: str, names: Sequence[str], change: Array) -> str:
        """Note of an iteration that was stopped."""
        worst = int(np.argmax(change))
        return (
            f"{method} has not converged after {self.iterations} iterations: {names[worst]} still changes by"
            f" {change[worst]:.2g} times the {100 * self.parameters:g} % (or {self.deviations:g} standard deviations)"
            " that are allowed. Record a motion that shows it better, or check the robot file's drive gains and control"
            " law."
        )


@dataclass(frozen=True)
class IdimIv:
    """IDIM-IV.

    Attributes:
        covariance: How the standard deviations are made.
        criterion: Convergence.
        update_gains: Eq. (22). Without, the law is the recorded one, and far starts may not be simulable.
    """

    covariance: Covariance = HAC
    criterion: Criterion = Criterion()
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
        model, base, criterion = problem.model, problem.base, self.criterion
        runs = auxiliary.runs(problem.signals)
        beta = base.B @ regular_start(model)
        norm, change, converged = float("inf"), np.full(len(beta), np.inf), False
        sound, history, k = beta, [], 0
        while k < criterion.iterations and not converged:
            instruments, sound, error = self._instruments(problem, runs, beta, sound, k)
            history.append(Iterate(beta.tolist(), error.tolist(), norm if k else None))
            system, sigma = weighted_system(problem.observations, instruments)
            refuse_deficient(system.instruments, base, instruments)
            solution = system.solve()
            change = criterion.change(solution.beta, beta, solution.std)
            now = residual_norm(problem.observations, solution.beta)
            converged = criterion.met(change, now, norm)
            beta, norm, k = solution.beta, now, k + 1
        final, simulated, error = self._instruments(problem, runs, beta, sound, k)
        history.append(Iterate(beta.tolist(), error.tolist(), norm))
        notes = [] if converged else [criterion.complaint(self.name, base.names, change)]
        if not np.array_equal(simulated, beta):
            notes.append(
                f"{self.name}: the estimate itself cannot be simulated (its mass matrix is not positive definite on this"
                " motion); the auxiliary model had parameters near it."
            )
        moments = _moments(problem.observations, instruments, system, solution, sigma)
        covariance, words = self.covariance.of(moments)
        return assemble(
            problem.observations,
            base,
            self.name,
            beta,
            covariance=covariance,
            covariance_name=words,
            white=moments.white,
            sigma_Nm=sigma,
            system=system,
            triangles=problem.triangles,
            notes=notes,
            iterations=k,
            converged=converged,
            history=history,
            tests=[hausman(problem.observations, final, sigma)],
        )

    def _instruments(
        self, problem: Problem, runs: Sequence[Run], beta: Array, sound: Array, k: int
    ) -> tuple[list[Observation], Array, Array]:
        """Columns of the arm simulated at beta or near it, the parameters it had, and its position errors."""
        try:
            simulated, used = auxiliary.simulate_near(
                runs, problem.model, problem.base, beta, sound, update_gains=self.update_gains
            )
        except IdentificationError as error:
            raise IdentificationError(f"{self.name}, iteration {k}: {error}") from error
        columns = [
            problem.observe(prepare(auxiliary.as_signals(run, stretches), dataset.filter_Hz))
            for run, stretches, dataset in zip(runs, simulated, problem.datasets, strict=True)
        ]
        return columns, used, auxiliary.position_error_percent(runs, simulated)


def regular_start(model: Model) -> Array:
    """Standard parameters of the regular initialisation (24), shape (P,): every motor's rotor is 1, all else 0. Where
    motor 6 turns with joint 5, this gives the paper's Ia5 = 2."""
    diagonal = (model.coupling**2).sum(axis=0)
    values = {f"Ia{j + 1}": float(value) for j, value in enumerate(diagonal)}
    values |= {f"ia_m{k + 1}": 1.0 for k in model.coupled}
    return np.array([values.get(name, 0.0) for name in model.names])


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


def residual_norm(observations: Sequence[Observation], beta: Array) -> float:
    """||Y - W beta|| over all rows used, not weighted [N·m]."""
    return float(np.sqrt(sum(np.sum(np.where(o.used, o.y - o.predict(beta), 0.0) ** 2) for o in observations)))


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


def _moments(
    observations: Sequence[Observation],
    instruments: Sequence[Observation],
    system: System,
    solution: Solution,
    sigma: Array,
) -> Moments:
    """What any covariance needs: an error e moves the estimate by inv(Z' W) Z' e (weighted)."""
    bread = np.asarray(np.linalg.inv(system.instruments.T @ system.W), dtype=np.float64)
    G = [
        np.where(o.used[:, :, None], z.W, 0.0) / sigma[:, None, None] ** 2
        for o, z in zip(observations, instruments, strict=True)
    ]
    return Moments(observations, solution.beta, bread, G, solution.inverse @ solution.inverse.T)
