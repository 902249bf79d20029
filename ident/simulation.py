"""How the arm with some parameters moves in closed loop, beside how it was recorded: the proof of a direct model."""

import numpy as np
from numpy.typing import NDArray

from ident import auxiliary, contract
from ident.dataset import prepare
from ident.problem import Problem

Array = NDArray[np.float64]


def closed_loop(problem: Problem, theta: Array) -> contract.Simulation:
    """Simulation of recordings under the recorded law, from the measured start.

    Positions are compared as measured; torques in the bandwidth and on the rows of the fit, where noise does not hide
    the difference.

    Args:
        problem: Recordings and how their rows are made.
        theta: Standard parameters, shape (P,).

    Raises:
        DataError, ConfigError: The reference or the control law is not known.
        IdentificationError: The parameters cannot be simulated.
    """
    runs = auxiliary.runs(problem.signals)
    simulated = auxiliary.simulate(runs, problem.model, theta, update_gains=False)
    rows = [
        problem.observe(prepare(auxiliary.as_signals(run, stretches), dataset.filter_Hz))
        for run, stretches, dataset in zip(runs, simulated, problem.datasets, strict=True)
    ]
    error, torque = np.zeros((2, problem.model.joints))
    for measured, o in zip(problem.observations, rows, strict=True):
        error += (np.where(measured.used, measured.y - o.y, 0.0) ** 2).sum(axis=1)
        torque += (np.where(measured.used, measured.y, 0.0) ** 2).sum(axis=1)
    relative = np.sqrt(np.divide(error, torque, out=np.full(len(torque), np.nan), where=torque > 0))
    return contract.Simulation(
        position_error_percent=[contract.finite(e) for e in auxiliary.position_error_percent(runs, simulated)],
        torque_error_percent=[contract.finite(100 * e) for e in relative],
        runs=[signals.source for signals in problem.signals],
    )
