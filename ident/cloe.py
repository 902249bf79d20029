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
from ident.iteration import regular_start
from ident.observation import Observation
from ident.problem import Problem
from ident.system import System, triangle
from protocols.errors import IdentificationError

Array = NDArray[np.float64]

ROWS_HZ = 100.0  # positions are averaged to this rate: ten times the bandwidth of the motion
SETTLED_S = 0.5  # after the start; when each drive was switched on, and the arm sank into its law, is not known exactly
CLOSE = 0.1  # radii of the confidence region, errors of positions being taken as uncorrelated
NEAR = 3.0  # the same; they are correlated over the settling time of the loop, so the true region is larger than this


@dataclass(frozen=True)
class _Point:
    """An iteration: parameters, their simulation, and how far it is from the recording."""

    beta: Array
    simulated: list[list[Simulation]]
    iterate: Iterate
    norm: float


@dataclass(frozen=True)
class Cloe:
    """CLOE.

    It has converged within a tenth of a radius of the confidence region from the best parameters, or within three where
    the output error does not fall any more: dry friction makes its last digits uneven.

    Attributes:
        start: `prior`, the parameters of the robot file, or `regular`, eq. (24).
        covariance: How the standard deviations are made.
        iterations: Most.
        halvings: Of a step that does not reduce the output error; 0 for the plain Gauss-Newton of the paper.
        settled: Relative fall of the output error that is none.
    """

    start: Literal["prior", "regular"] = "prior"
    covariance: Covariance = HAC
    iterations: int = 30
    halvings: int = 5
    settled: float = 1e-3
    name: str = "CLOE"

    def fit(self, problem: Problem) -> Estimate:
        """Gauss-Newton with halved steps where a whole one is too long.

        Raises:
            DataError, ConfigError: The reference or the control law is not known.
            IdentificationError: The start cannot be simulated, no step reduces the error, or the iteration does not
                converge; says what to do.
        """
        runs = auxiliary.runs(problem.signals)
        start = regular_start(problem.model) if self.start == "regular" else problem.model.theta(problem.model.robot)
        try:
            point = _simulate(problem, runs, problem.base.B @ start)
        except IdentificationError as error:
            raise IdentificationError(f"{self.name}, start: {error}") from error
        history, fall = [point.iterate], float("inf")
        while True:
            rows = _output_rows(problem, runs, point)
            triangles = joint_triangles(rows)
            try:
                refuse_deficient(triangle(triangles)[:, :-1], problem.base, rows)
            except IdentificationError as error:
                raise IdentificationError(
                    self._lost(problem, history, "positions do not show the parameters")
                ) from error
            sigma = joint_sigma(triangles, joint_rows(rows))
            system = System.of_triangle(triangle([t / s for t, s in zip(triangles, sigma, strict=True)]))
            away = _offset(system, point.beta)
            if away <= CLOSE or (away <= NEAR and fall <= self.settled):
                return self._estimate(problem, rows, point.beta, history, system, sigma)
            if len(history) > self.iterations:
                raise IdentificationError(self._lost(problem, history, f"no convergence (still {away:.2g} radii away)"))
            better = self._step(problem, runs, point, system.solve().beta)
            if better is None and away <= NEAR:
                return self._estimate(problem, rows, point.beta, history, system, sigma)
            if better is None:
                raise IdentificationError(self._lost(problem, history, "no step reduces the output error"))
            fall = 1 - better.norm / point.norm
            point = better
            history.append(point.iterate)

    def _step(self, problem: Problem, runs: Sequence[Run], point: _Point, target: Array) -> _Point | None:
        """A point on the way to the target that can be simulated and is not further from the recording."""
        for halving in range(self.halvings + 1):
            try:
                found = _simulate(problem, runs, point.beta + (target - point.beta) / 2**halving)
            except IdentificationError:
                continue
            if found.norm <= (1 + self.settled) * point.norm:
                return found
        return None

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
        self,
        problem: Problem,
        rows: Sequence[Observation],
        beta: Array,
        history: Sequence[Iterate],
        system: System,
        sigma: Array,
    ) -> Estimate:
        """
        Args:
            rows, system, sigma: Linearised output at beta, and the deviations of positions [rad].
        """
        inverse = system.solve().inverse
        covariance, words = self.covariance.of(Moments.weighted(rows, beta, sigma, inverse @ inverse.T))
        return assemble(
            problem.observations,
            problem.base,
            self.name,
            beta,
            covariance=covariance,
            covariance_name=f"{words}; of positions",
            white=inverse @ inverse.T,
            sigma_Nm=joint_sigma(problem.triangles, joint_rows(problem.observations)),
            system=system,
            triangles=problem.triangles,
            iterations=len(history) - 1,
            history=history,
        )


def _offset(system: System, beta: Array) -> float:
    """How far beta is from the best, in radii of the confidence region: Bates & Watts 1981 (Technometrics 23, 179-183).

    Below a tenth there is nothing left to gain, whatever dry friction does to the last digits of a simulation.
    """
    along = np.linalg.qr(system.W)[0].T @ (system.y - system.W @ beta)  # rows are weighted to unit variance
    return float(np.linalg.norm(along) / np.sqrt(len(beta)))


def _simulate(problem: Problem, runs: Sequence[Run], beta: Array) -> _Point:
    standard = auxiliary.standard(problem.base, beta)
    simulated = auxiliary.simulate(runs, problem.model, standard, update_gains=False)
    square = sum(
        float(np.sum((run.signals.q[stretch.rows][stretch.lead :] - simulation.q) ** 2))
        for run, stretches in zip(runs, simulated, strict=True)
        for stretch, simulation in zip(run.stretches, stretches, strict=True)
    )
    norm = float(np.sqrt(square))
    iterate = Iterate(beta.tolist(), auxiliary.position_error_percent(runs, simulated).tolist(), norm)
    return _Point(beta, simulated, iterate, norm)


def _output_rows(problem: Problem, runs: Sequence[Run], point: _Point) -> list[Observation]:
    """Linearised output: q - qs + S beta = S beta' + error, averaged to `ROWS_HZ`; one observation per recording."""
    return [_output(problem, run, simulated, point.beta) for run, simulated in zip(runs, point.simulated, strict=True)]


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
