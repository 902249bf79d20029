"""Noise of recorded positions and where it gets to: filtered states, columns, modelled torques."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ident.dataset import Dataset, differences, lowpass
from ident.observation import Observation, decimate
from ident.problem import Problem

Array = NDArray[np.float64]

DIFFERENCES, GAIN = 6, 924.0  # sixth differences of unit white noise; a 10 Hz motion at 1 kHz leaves 6e-8 of itself
NORMAL_MAD = 0.6745  # median of |x| for a standard normal x
STEPS = (1e-5, 1e-4, 1e-3)  # of q, dq, ddq for central differences of columns: error 1e-10, rounding 1e-11
ROWS = 2000  # of a recording, enough for a root mean square over its motion


class States(NamedTuple):
    """States at the rows of an observation, each of shape (N, J) [rad, rad/s, rad/s²]."""

    q: Array
    qd: Array
    qdd: Array


def states(dataset: Dataset, o: Observation) -> States:
    """Full-rate states at the times of the rows."""
    times = np.concatenate([s.t_s for s in dataset.segments])
    at = np.searchsorted(times, o.t_s - 0.5 * dataset.period_s)
    q, qd, qdd = (np.concatenate([getattr(s, name) for s in dataset.segments])[at] for name in States._fields)
    return States(q, qd, qdd)


def position_noise(q: Array) -> float:
    """Standard deviation of white noise on recorded positions, root mean square over joints [rad].

    Args:
        q: As recorded, shape (T, J).
    """
    return float(np.sqrt(np.mean(white_noise(q) ** 2)))


def white_noise(x: Array) -> Array:
    """Standard deviation of white noise on smooth signals by their sixth differences, shape (J,).

    The median leaves out jumps; where most differences are zero (an encoder at rest) it is the root mean square.

    Args:
        x: shape (T, J).
    """
    d = np.diff(x, n=DIFFERENCES, axis=0)
    middle = np.median(np.abs(d), axis=0) / NORMAL_MAD
    return np.asarray(np.where(middle > 0, middle, np.sqrt(np.mean(d**2, axis=0))) / np.sqrt(GAIN))


def state_covariance(dataset: Dataset, o: Observation) -> Array:
    """Covariance of a row's (q, dq, ddq) of one joint for unit white noise on the recorded q, shape (3, 3)."""
    factor = max(1, round(1 / dataset.period_s / o.rate_Hz))
    memory = 10 / (dataset.filter_Hz * dataset.period_s) if np.isfinite(dataset.filter_Hz) else 10
    middle = int(memory) + 50 * factor
    impulse = np.zeros((2 * middle + 1, 1))
    impulse[middle] = 1.0
    q = lowpass(impulse, dataset.period_s, dataset.filter_Hz)
    responses = decimate(np.column_stack([q, *differences(q, dataset.period_s)]), factor)
    return np.asarray(responses.T @ responses)


def columns(problem: Problem, x: States) -> Array:
    """Base columns at states, shape (J, N, b)."""
    return np.asarray(problem.model.regressor(*x)[:, :, problem.base.kept])


def signs(problem: Problem) -> NDArray[np.bool_]:
    """Columns that are signs of speeds, shape (b,): no slope, as long as rows around zero speed are left out."""
    base = problem.base
    return np.array([base.standard[k].startswith(("Fc", "fc_m")) for k in base.kept])


def moved(x: States, joint: int, kind: int, step: float) -> States:
    """States with q (0), dq (1) or ddq (2) of one joint moved."""
    out = list(x)
    out[kind] = x[kind].copy()
    out[kind][:, joint] += step
    return States(*out)


def torque_slopes(problem: Problem, x: States, beta: Array) -> Array:
    """Derivative of W(x) beta by the state, shape (N, J, 3 J); x in the order joint, then (q, dq, ddq)."""
    J = problem.model.joints
    smooth = np.where(signs(problem), 0.0, beta)
    out = np.empty((len(x.q), J, 3 * J))
    for j in range(J):
        for kind, step in enumerate(STEPS):
            high, low = (columns(problem, moved(x, j, kind, s)) @ smooth for s in (step, -step))
            out[:, :, 3 * j + kind] = (high - low).T / (2 * step)
    return out


def column_errors(problem: Problem, sigma: Array, noise: float | None = None) -> Array:
    """Covariance of a row's column errors over the variance of its torque error, mean over rows, shape (b, b).

    Args:
        sigma: Standard deviation of the torque error per joint, shape (J,).
        noise: Of the recorded positions [rad]; None to estimate it.
    """
    b = len(problem.base.kept)
    out, rows = np.zeros((b, b)), 0
    for signals, dataset, o in zip(problem.signals, problem.datasets, problem.observations, strict=True):
        x = states(dataset, o)
        part = slice(None, None, max(1, len(x.q) // ROWS))
        x, used = States(*(v[part] for v in x)), o.used[:, part]
        C = state_covariance(dataset, o) * (position_noise(signals.q) if noise is None else noise) ** 2
        weight = np.where(used, 1 / sigma[:, None], 0.0)[:, :, None]
        for j in range(problem.model.joints):
            slopes = np.stack(
                [
                    ((columns(problem, moved(x, j, k, s)) - columns(problem, moved(x, j, k, -s))) / (2 * s) * weight)
                    .reshape(-1, b)
                    for k, s in enumerate(STEPS)
                ]
            )  # fmt: skip
            out += sum(C[a, c] * slopes[a].T @ slopes[c] for a in range(3) for c in range(3))
        rows += int(used.sum())
    smooth = ~signs(problem)
    return np.asarray(out * np.outer(smooth, smooth) / max(1, rows))
