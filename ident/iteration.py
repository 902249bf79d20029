"""Methods that simulate, solve a linear system made of the simulation, and simulate again: IDIM-IV and DIDIM."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.simulator import Simulation
from ident import auxiliary
from ident.auxiliary import Run
from ident.contract import Iterate
from ident.dataset import prepare
from ident.model import Model
from ident.observation import Observation
from ident.problem import Problem
from ident.system import Solution, System
from protocols.errors import IdentificationError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Criterion:
    """When an iteration has converged, eq. (27) of Janot, Vandanjon & Gautier 2014.

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


PAPER = Criterion()  # tol1 = tol2 = 2.5 % (V.A)


@dataclass(frozen=True)
class Step:
    """One linear system.

    Attributes:
        rows: Y = W beta + rho, whose residual the criterion looks at.
        system: Weighted, in few rows.
        sigma: Of the errors per joint, shape (J,).
    """

    rows: Sequence[Observation]
    system: System
    sigma: Array


@dataclass(frozen=True)
class Outcome:
    """Where an iteration ended.

    Attributes:
        beta: shape (b,).
        step, solution, columns: Of the last system: what it was, its solution, the simulated columns it had.
        history: Every iteration, the start first.
        notes: If it was stopped, or beta itself cannot be simulated.
    """

    beta: Array
    step: Step
    solution: Solution
    columns: list[Observation]
    history: list[Iterate]
    converged: bool
    notes: list[str]

    @property
    def iterations(self) -> int:
        return len(self.history) - 1


def regular_start(model: Model) -> Array:
    """Standard parameters of the regular initialisation (24), shape (P,): every motor's rotor is 1, all else 0. Where
    motor 6 turns with joint 5, this gives the paper's Ia5 = 2."""
    diagonal = (model.coupling**2).sum(axis=0)
    values = {f"Ia{j + 1}": float(value) for j, value in enumerate(diagonal)}
    values |= {f"ia_m{k + 1}": 1.0 for k in model.coupled}
    return np.array([values.get(name, 0.0) for name in model.names])


def iterate(
    problem: Problem,
    name: str,
    solve: Callable[[list[Observation]], Step],
    criterion: Criterion,
    *,
    update_gains: bool,
) -> Outcome:
    """From the regular initialisation until the criterion is met.

    Args:
        solve: Linear system of simulated columns.

    Raises:
        DataError, ConfigError: As `auxiliary.runs` and `auxiliary.simulate`.
        IdentificationError: As `solve`, or the auxiliary model cannot be simulated; says at which iteration.
    """
    base = problem.base
    runs = auxiliary.runs(problem.signals)
    beta = sound = base.B @ regular_start(problem.model)
    norm, converged = float("inf"), False
    history: list[Iterate] = []
    while len(history) < criterion.iterations and not converged:
        columns, sound, error = _columns(problem, name, runs, beta, sound, update_gains, len(history))
        history.append(Iterate(beta.tolist(), error.tolist(), norm if history else None))
        step = solve(columns)
        solution = step.system.solve()
        change = criterion.change(solution.beta, beta, solution.std)
        now = residual_norm(step.rows, solution.beta)
        converged = criterion.met(change, now, norm)
        beta, norm = solution.beta, now
    simulations, simulated = _simulate(problem, name, runs, beta, sound, update_gains, len(history))
    error = auxiliary.position_error_percent(runs, simulations)
    history.append(Iterate(beta.tolist(), error.tolist(), norm))
    notes = [] if converged else [criterion.complaint(name, base.names, change)]
    if not np.array_equal(simulated, beta):
        notes.append(
            f"{name}: the estimate itself cannot be simulated (its mass matrix is not positive definite on this"
            " motion); the auxiliary model had parameters near it."
        )
    return Outcome(beta, step, solution, columns, history, converged, notes)


def residual_norm(observations: Sequence[Observation], beta: Array) -> float:
    """||Y - W beta|| over all rows used, not weighted [N·m]."""
    return float(np.sqrt(sum(np.sum(np.where(o.used, o.y - o.predict(beta), 0.0) ** 2) for o in observations)))


def _columns(
    problem: Problem, name: str, runs: Sequence[Run], beta: Array, sound: Array, update_gains: bool, k: int
) -> tuple[list[Observation], Array, Array]:
    """Columns of the arm simulated at beta or near it, the parameters it had, and its position errors."""
    simulated, used = _simulate(problem, name, runs, beta, sound, update_gains, k)
    columns = [
        problem.observe(prepare(auxiliary.as_signals(run, stretches), dataset.filter_Hz))
        for run, stretches, dataset in zip(runs, simulated, problem.datasets, strict=True)
    ]
    return columns, used, auxiliary.position_error_percent(runs, simulated)


def _simulate(
    problem: Problem, name: str, runs: Sequence[Run], beta: Array, sound: Array, update_gains: bool, k: int
) -> tuple[list[list[Simulation]], Array]:
    try:
        return auxiliary.simulate_near(runs, problem.model, problem.base, beta, sound, update_gains=update_gains)
    except IdentificationError as error:
        raise IdentificationError(f"{name}, iteration {k}: {error}") from error
