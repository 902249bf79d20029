"""Extended Kalman filter with the parameters in its state (Gautier & Poignet 2001).

The comparison that Janot et al. 2014 name in their introduction. State (q, dq, beta), driven by the measured torque
through the direct model and corrected by the measured position; no differentiation and no position filter. It needs
a start (the robot file's parameters and their sigmas) and tuning, and sees every sample once.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.dataset import Segment, Signals
from ident.estimate import Estimate, assemble, joint_rows, joint_sigma, refuse_deficient
from ident.positionnoise import position_noise, white_noise
from ident.problem import Problem
from ident.system import triangle
from ident.writeback import prior_sigma
from protocols.errors import IdentificationError

Array = NDArray[np.float64]

FINEST_RAD = 1e-8  # position noise assumed at least
STEP = 1e-6  # of q and dq for the model's slopes
TURNING = 3.0  # standard deviations of a speed within which its sign is uncertain
LOST = 1000.0  # innovation in its standard deviations; wrong parameters alone give tens at a turn


@dataclass(frozen=True)
class ExtendedKalman:
    """EKF over the recordings in their order.

    Attributes:
        prior_factor: Standard deviations of the start over those of the robot file.
        passes: Times the recordings are run through, each starting from the end of the one before with fresh
            covariance; 1 is the filter as published.
        rate_Hz: Of the filter's steps, at most: the arm's own motion is below 50 Hz.
    """

    prior_factor: float = 1.0
    passes: int = 1
    rate_Hz: float = 1000.0

    @property
    def name(self) -> str:
        return "EKF"

    def fit(self, problem: Problem) -> Estimate:
        """Filter all recordings.

        Raises:
            IdentificationError: The motion does not show some base parameters, or the filter lost the motion.
        """
        observations, base, model = problem.observations, problem.base, problem.model
        refuse_deficient(triangle(problem.triangles)[:, :-1], base, observations)
        sigma = joint_sigma(problem.triangles, joint_rows(observations))
        beta = base.B @ model.theta(model.robot)
        spread = base.B * (self.prior_factor * prior_sigma(model))
        prior = np.asarray(spread @ spread.T)
        for _ in range(self.passes):
            P = prior
            for signals, dataset in zip(problem.signals, problem.datasets, strict=True):
                for segment in dataset.segments:
                    beta, P = _filter(problem, signals, segment, sigma, beta, P, self.rate_Hz)
        return assemble(
            observations,
            base,
            self.name,
            beta,
            covariance=P,
            covariance_name="EKF (the filter's own: torque and position errors uncorrelated in time)",
            white=P,
            sigma_Nm=sigma,
            triangles=problem.triangles,
            iterations=self.passes,
        )


def _filter(
    problem: Problem, signals: Signals, segment: Segment, sigma: Array, beta: Array, P_beta: Array, rate_Hz: float
) -> tuple[Array, Array]:
    """Parameters and their covariance after one gapless stretch."""
    J, b = problem.model.joints, len(beta)
    period = float(segment.t_s[1] - segment.t_s[0])
    every = max(1, round(1 / period / rate_Hz))
    at = np.searchsorted(signals.t_s, segment.t_s - period / 2)[::every]
    q, tau = signals.q[at], segment.tau_Nm[::every]
    dt = every * period
    noise = max(position_noise(signals.q), FINEST_RAD)
    torque = np.sqrt(white_noise(segment.tau_Nm) ** 2 + sigma**2)
    x = np.concatenate([q[0], segment.qd[0], beta])
    P = np.zeros((2 * J + b, 2 * J + b))
    P[:J, :J] = noise**2 * np.eye(J)
    P[J : 2 * J, J : 2 * J] = (noise / dt) ** 2 * np.eye(J)
    P[2 * J :, 2 * J :] = P_beta
    for k in range(1, len(q)):
        before = x
        x, F, M_inverse = predict(problem, x, (tau[k - 1] + tau[k]) / 2, dt)
        error = np.hypot(torque, _turning(problem, before, x, P))
        P = F @ P @ F.T
        push = np.vstack([dt**2 / 2 * M_inverse, dt * M_inverse]) * error
        P[: 2 * J, : 2 * J] += push @ push.T
        S = P[:J, :J] + noise**2 * np.eye(J)
        K = np.linalg.solve(S, P[:J]).T
        innovation = q[k] - x[:J]
        if not innovation @ np.linalg.solve(S, innovation) < J * LOST**2:
            raise IdentificationError(
                f"{signals.source}: the EKF lost the motion at {signals.t_s[at[k]]:.2f} s (predicted position off by"
                f" {np.abs(innovation).max():.2g} rad). Start from better a-priori parameters, or use wls or iv."
            )
        x = x + K @ innovation
        P = P - K @ P[:J]
        P = (P + P.T) / 2
    return x[2 * J :], P[2 * J :, 2 * J :]


def predict(problem: Problem, x: Array, tau: Array, dt: float) -> tuple[Array, Array, Array]:
    """State one step later, its derivative by the state, and inv(M).

    Constant acceleration over the step, that of its middle (the speed's part linearised: explicit steps would count
    0.4 % of friction as inertia at 1 kHz); M(q) and slopes from the regressor, d ddq / d beta = -inv(M) W(q, dq, ddq).
    """
    J = problem.model.joints
    q, qd, beta = x[:J] + dt / 2 * x[J : 2 * J], x[J : 2 * J], x[2 * J :]
    kept = problem.base.kept
    still, unit = np.zeros(J), np.eye(J)
    Q = np.tile(q, (J + 2, 1))
    V = np.vstack([qd, np.zeros((J + 1, J))])
    A = np.vstack([still, still, unit])
    torques = problem.model.regressor(Q, V, A)[:, :, kept] @ beta  # (J, J + 2)
    M = torques[:, 2:] - torques[:, [1]]
    if not np.linalg.eigvalsh((M + M.T) / 2)[0] > 0:
        raise IdentificationError(
            "The EKF lost its way: the inertia matrix of its parameters is no longer positive. Start from better"
            " a-priori parameters or smaller sigmas (a start far off is what it does not survive), or use wls or iv."
        )
    M_inverse = np.linalg.inv(M)
    qdd = M_inverse @ (tau - torques[:, 0])
    Q = np.vstack([q, q + STEP * unit, np.tile(q, (J, 1))])
    V = np.vstack([qd, np.tile(qd, (J, 1)), qd + STEP * unit])
    W = problem.model.regressor(Q, V, np.tile(qdd, (2 * J + 1, 1)))[:, :, kept]
    torques = W @ beta
    by_q = -M_inverse @ (torques[:, 1 : J + 1] - torques[:, [0]]) / STEP
    by_qd = -M_inverse @ (torques[:, J + 1 :] - torques[:, [0]]) / STEP
    by_beta = -M_inverse @ W[:, 0]
    qdd = np.asarray(np.linalg.solve(np.eye(J) - dt / 2 * by_qd, qdd), dtype=float)
    F = np.eye(len(x))
    F[J : 2 * J] += dt * np.hstack([by_q, by_qd, by_beta])
    F[:J] += dt**2 / 2 * np.hstack([by_q, by_qd, by_beta])
    F[:J, J : 2 * J] += dt * np.eye(J)
    ahead = np.concatenate([x[:J] + dt * qd + dt**2 / 2 * qdd, qd + dt * qdd, beta])
    return ahead, F, np.asarray(M_inverse, dtype=float)


def _turning(problem: Problem, before: Array, after: Array, P: Array) -> Array:
    """Coulomb torque per joint of the axes whose direction is uncertain over a step, shape (J,) [N·m].

    The sign's step has no slope that a Kalman filter could use: the torque is taken as unknown by as much.
    """
    J, C = problem.model.joints, problem.model.coupling
    std = np.sqrt(np.maximum(np.diag(C @ P[J : 2 * J, J : 2 * J] @ C.T), 0.0))
    speeds = np.array([C @ before[J : 2 * J], C @ after[J : 2 * J]])
    uncertain = (np.abs(speeds).min(axis=0) < TURNING * std + np.abs(speeds[1] - speeds[0])).astype(float)
    size = np.abs(after[2 * J :])
    value = {problem.base.standard[k]: v for k, v in zip(problem.base.kept, size, strict=True)}
    own = np.array([value.get(f"Fc{j + 1}", 0.0) for j in range(J)])
    motor = np.array([value.get(f"fc_m{j + 1}", 0.0) for j in range(J)])
    return np.asarray(uncertain * own + np.abs(C).T @ (uncertain * motor))
