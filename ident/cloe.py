"""CLOE: closed-loop output error, Gauss-Newton on simulated positions (Janot, Vandanjon & Gautier 2014, V.E).

The arm is simulated under the recorded law, without gain updating, from the measured start, and the parameters are
moved until its positions are the measured ones. The sensitivities come from the linearised model along the simulation.
No measured signal is differentiated and no torque is used: the law's own gains set the scale.

Sensitive to its start, as the paper says: from an a-priori robot it converges, from the regular initialisation not.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from emulator import sensitivity
from emulator.simulator import Simulation
from ident import auxiliary
from ident.auxiliary import Run
from ident.contract import Iterate
from ident.covariance import HAC, Covariance, Moments
from ident.estimate import Estimate, assemble, joint_rows, joint_sigma, joint_triangles, refuse_deficient
from ident.iteration import Criterion, regular_start
from ident.observation import Observation
from ident.problem import Problem
from ident.system import Solution, System, triangle
from protocols.errors import IdentificationError

Array = NDArray[np.float64]

ROWS_HZ = 100.0  # positions are averaged to this rate: ten times the bandwidth of the motion
SETTLED_S = 0.5  # after the start; when each drive was switched on, and the arm sank into its law, is not known exactly
HALVINGS = 5  # of a step that does not reduce the output error
GAUSS_NEWTON = Criterion(residual=1e-3, parameters=0.01, deviations=0.1, iterations=30)


@dataclass(frozen=True)
class Cloe:
    """CLOE.

    Attributes:
        start: `prior`, the parameters of the robot file, or `regular`, eq. (24).
        covariance: How the standard deviations are made.
        criterion: Convergence.
    """

    start: Literal["prior", "regular"] = "prior"
    covariance: Covariance = HAC
    criterion: Criterion = GAUSS_NEWTON
    name: str = "CLOE"

    def fit(self, problem: Problem) -> Estimate:
        """Gauss-Newton with halved steps where a whole one is too long.

        Raises:
            DataError, ConfigError: The reference or the control law is not known.
            IdentificationError: The start cannot be simulated, no step reduces the error, or the iteration does not
                converge; says what to do.
        """
        base, criterion = problem.base, self.criterion
        runs = auxiliary.runs(problem.signals)
        standard = regular_start(problem.model) if self.start == "regular" else problem.model.theta(problem.model.robot)
        beta = base.B @ standard
        try:
            simulated = _simulate(problem, runs, beta)
        except IdentificationError as error:
            raise IdentificationError(f"{self.name}, start: {error}") from error
        history = [_iterate(runs, simulated, beta)]
        converged = False
        while not converged:
            if len(history) > criterion.iterations:
                raise IdentificationError(self._lost(problem, history, "it has not settled"))
            rows = _output_rows(problem, runs, simulated, beta)
            solution, _, _ = _solve(rows, problem)
            target, stepped = solution.beta, None
            for halving in range(HALVINGS + 1):
                wanted = beta + (target - beta) / 2**halving
                stepped = self._try(problem, runs, wanted, history[-1])
                if stepped is not None:
                    break
            if stepped is None:
                raise IdentificationError(self._lost(problem, history, "no step reduces the output error"))
            change = criterion.change(wanted, beta, solution.std)
            now, before = stepped[1].residual_norm or 0.0, history[-1].residual_norm or 0.0
            converged = halving == 0 and criterion.met(change, now, before)
            beta, simulated = wanted, stepped[0]
            history.append(stepped[1])
        return self._estimate(problem, _output_rows(problem, runs, simulated, beta), beta, history)

    def _try(
        self, problem: Problem, runs: Sequence[Run], beta: Array, last: Iterate
    ) -> tuple[list[list[Simulation]], Iterate] | None:
        """Simulations at beta; None where it cannot be simulated or is further from the recording than before."""
        try:
            simulated = _simulate(problem, runs, beta)
        except IdentificationError:
            return None
        iterate = _iterate(runs, simulated, beta)
        worse = (iterate.residual_norm or 0.0) > (1 + self.criterion.residual) * (last.residual_norm or 0.0)
        return None if worse else (simulated, iterate)

    def _lost(self, problem: Problem, history: Sequence[Iterate], why: str) -> str:
        errors = ", ".join(
            f"{name} {error:.3g} %"
            for name, error in zip(problem.signals[0].joints, history[-1].position_error_percent, strict=True)
        )
        where = "the regular initialisation" if self.start == "regular" else "the robot file's parameters"
        return (
            f"{self.name} from {where}: {why} after {len(history) - 1} iterations; the simulated positions are off by"
            f" {errors}. Output error needs a start near the answer: give a robot file identified by iv, or use iv."
        )

    def _estimate(
        self, problem: Problem, rows: Sequence[Observation], beta: Array, history: Sequence[Iterate]
    ) -> Estimate:
        solution, sigma, system = _solve(rows, problem)
        white = solution.inverse @ solution.inverse.T
        covariance, words = self.covariance.of(Moments.weighted(rows, beta, sigma, white))
        return assemble(
            problem.observations,
            problem.base,
            self.name,
            beta,
            covariance=covariance,
            covariance_name=f"{words}; of positions",
            white=white,
            sigma_Nm=joint_sigma(problem.triangles, joint_rows(problem.observations)),
            system=system,
            triangles=problem.triangles,
            iterations=len(history) - 1,
            history=history,
        )


def _simulate(problem: Problem, runs: Sequence[Run], beta: Array) -> list[list[Simulation]]:
    return auxiliary.simulate(runs, problem.model, auxiliary.standard(problem.base, beta), update_gains=False)


def _iterate(runs: Sequence[Run], simulated: Sequence[Sequence[Simulation]], beta: Array) -> Iterate:
    square = sum(
        float(np.sum((run.signals.q[stretch.rows][stretch.lead :] - simulation.q) ** 2))
        for run, stretches in zip(runs, simulated, strict=True)
        for stretch, simulation in zip(run.stretches, stretches, strict=True)
    )
    return Iterate(beta.tolist(), auxiliary.position_error_percent(runs, simulated).tolist(), float(np.sqrt(square)))


def _output_rows(
    problem: Problem, runs: Sequence[Run], simulated: Sequence[Sequence[Simulation]], beta: Array
) -> list[Observation]:
    """Linearised output: q - qs + S beta = S beta' + error, averaged to `ROWS_HZ`; one observation per recording."""
    return [_output(problem, run, stretches, beta) for run, stretches in zip(runs, simulated, strict=True)]


def _output(problem: Problem, run: Run, simulated: Sequence[Simulation], beta: Array) -> Observation:
    model, base = problem.model, problem.base
    times, columns, values, first = [], [], [], []
    for stretch, simulation in zip(run.stretches, simulated, strict=True):
        W = model.regressor(*sensitivity.midpoints(simulation))[:, :, base.kept]
        S = sensitivity.sensitivities(simulation, W).q
        error = (run.signals.q[stretch.rows][stretch.lead :] - simulation.q).T
        count = max(1, round(1 / (ROWS_HZ * simulation.step_s)))
        begin = min(round(SETTLED_S / simulation.step_s), error.shape[1] // 2)
        N = (error.shape[1] - begin) // count
        part = slice(begin, begin + N * count)
        S = S[:, part].reshape(len(S), N, count, -1).mean(axis=2)
        columns.append(S)
        values.append(error[:, part].reshape(len(error), N, count).mean(axis=2) + S @ beta)
        times.append(run.signals.t_s[stretch.rows][stretch.lead :][part][::count])
        first.append(np.arange(N) == 0)
    y = np.concatenate(values, axis=1)
    return Observation(
        source=run.signals.source,
        joints=run.signals.joints,
        t_s=np.concatenate(times),
        first=np.concatenate(first),
        W=np.concatenate(columns, axis=1),
        y=y,
        used=np.ones(y.shape, dtype=bool),
        rate_Hz=ROWS_HZ,
        bandwidth_Hz=ROWS_HZ / 2,
        notes=[],
    )


def _solve(rows: Sequence[Observation], problem: Problem) -> tuple[Solution, Array, System]:
    """Next parameters, deviations of the positions per joint [rad], and the system."""
    triangles = joint_triangles(rows)
    refuse_deficient(triangle(triangles)[:, :-1], problem.base, rows)
    sigma = joint_sigma(triangles, joint_rows(rows))
    system = System.of_triangle(triangle([t / s for t, s in zip(triangles, sigma, strict=True)]))
    return system.solve(), sigma, system
