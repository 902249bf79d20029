"""The arm under its control law from the first sample of a reference to the last, in compiled code.

Two integrators. `runge_kutta` is of fourth order and needs dry friction as a smooth function of speed. `leapfrog` is
of second order, needs a quarter of the evaluations and takes dry friction exactly (emulator/friction.py).
"""

import numpy as np

from emulator.forward import Chain, Terms, Work, evaluate, row_speed, smooth_acceleration, workspace
from emulator.friction import factor, rub, solve
from emulator.kernels import Floats, compiled
from emulator.law import Aim, Law, Path, command, integrate_error, look_ahead

DONE, NOT_POSITIVE, LOST = 0, 1, 2
STANDING = 1e-9  # rad/s; what a joint at rest has left after `friction.rub`, reported as 0 so that its sign is 0
_NODE = (0.0, 0.5, 0.5, 1.0)  # of the step, at which the stages of the fourth-order method stand
_SHARE = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
_RUNAWAY = 1e4  # rad/s, a thousand times what an arm can do


@compiled
def _sampled(
    law: Law,
    model: Terms | None,
    chain: Chain,
    aim: Aim,
    q: Floats,
    qd: Floats,
    seen: Floats,
    seen_speed: Floats,
    sum_: Floats,
    period: float,
    work: Work,
    speed: Floats,
    tau: Floats,
) -> None:
    """One control instant: takes in the state, fills tau from the state `law.delay` periods ago.

    Args:
        seen, seen_speed: States at the last control instants, the newest first, shape (delay + 2, J).
        speed: Scratch.
    """
    J = len(q)
    for k in range(len(seen) - 1, 0, -1):
        for j in range(J):
            seen[k, j], seen_speed[k, j] = seen[k - 1, j], seen_speed[k - 1, j]
    seen[0, :] = q
    seen_speed[0, :] = qd
    integrate_error(law, aim, seen[law.delay], speed)
    for j in range(J):
        sum_[j] += period * speed[j]
    for j in range(J):
        if law.difference:
            speed[j] = (seen[law.delay, j] - seen[law.delay + 1, j]) / period
        else:
            speed[j] = seen_speed[law.delay, j]
    command(law, model, chain, aim, seen[law.delay], speed, sum_, work, tau)


@compiled
def _remember(law: Law, q: Floats, qd: Floats, period: float) -> tuple[Floats, Floats]:
    """States before the first control instant: as if the arm had come at constant speed."""
    J = len(q)
    seen, seen_speed = np.empty((law.delay + 2, J)), np.empty((law.delay + 2, J))
    for k in range(law.delay + 2):
        for j in range(J):
            seen[k, j] = q[j] - (k + 1) * period * qd[j]
            seen_speed[k, j] = qd[j]
    return seen, seen_speed


@compiled
def _why(q: Floats, qd: Floats, otherwise: int) -> int:
    """LOST where the arm has run away, which shows in the mass matrix too."""
    for j in range(len(q)):
        if not (np.isfinite(q[j]) and abs(qd[j]) < _RUNAWAY):
            return LOST
    return otherwise


@compiled
def _record(q: Floats, qd: Floats, qdd: Floats, tau: Floats, out: Floats) -> None:
    """Fills out, shape (4, J), with one sample."""
    for j in range(len(q)):
        out[0, j] = q[j]
        out[1, j] = qd[j] if abs(qd[j]) > STANDING else 0.0
        out[2, j] = qdd[j]
        out[3, j] = tau[j]


@compiled
def runge_kutta(
    chain: Chain,
    terms: Terms,
    steepness: Floats,
    law: Law,
    model: Terms | None,
    path: Path,
    start: Floats,
    substeps: int,
    out: Floats,
) -> tuple[int, int]:
    """Fourth-order Runge-Kutta with dry friction dry * tanh(steepness * speed).

    Args:
        model: Of computed torque.
        path: Reference on the sample grid.
        start: Position and speed of the first sample, shape (2, J).
        substeps: Integration steps per sample.
        out: Filled with q, qd, qdd, tau at the samples, shape (4, T, J).

    Returns:
        DONE, NOT_POSITIVE or LOST, and the sample.
    """
    T, J = path.q.shape
    h = path.step / substeps
    work, aim = workspace(J), Aim(np.empty(J), np.empty(J), np.empty(J))
    q, v, z, tau = start[0].copy(), start[1].copy(), np.zeros(J), np.zeros(J)
    at_q, at_v, at_z, acceleration, error = np.empty(J), np.empty(J), np.empty(J), np.empty(J), np.zeros(J)
    next_q, next_v, next_z = np.empty(J), np.empty(J), np.empty(J)
    seen, seen_speed = _remember(law, q, v, law.hold * h)
    look_ahead(path, 0, 0.0, aim)
    for n in range(T):
        for s in range(substeps):
            if law.hold and (n * substeps + s) % law.hold == 0:
                look_ahead(path, n, s / substeps, aim)
                _sampled(law, model, chain, aim, q, v, seen, seen_speed, z, law.hold * h, work, at_v, tau)
            for j in range(J):
                at_q[j], at_v[j], at_z[j] = q[j], v[j], z[j]
                next_q[j], next_v[j], next_z[j] = q[j], v[j], z[j]
            for stage in range(4):
                if not law.hold:
                    if stage in (1, 3):  # the others are at the time of the one before
                        look_ahead(path, n, (s + _NODE[stage]) / substeps, aim)
                    command(law, model, chain, aim, at_q, at_v, at_z, work, tau)
                    integrate_error(law, aim, at_q, error)
                if not smooth_acceleration(chain, terms, steepness, at_q, at_v, tau, work, acceleration):
                    return _why(at_q, at_v, NOT_POSITIVE), n
                if stage == 0 and s == 0:
                    _record(q, v, acceleration, tau, out[:, n])
                    why = _why(q, v, DONE)
                    if why != DONE or n == T - 1:
                        return why, n
                share, ahead = h * _SHARE[stage], h * _NODE[(stage + 1) % 4]
                for j in range(J):
                    next_q[j] += share * at_v[j]
                    next_v[j] += share * acceleration[j]
                    next_z[j] += share * error[j]
                    at_q[j] = q[j] + ahead * at_v[j]
                    at_v[j] = v[j] + ahead * acceleration[j]
                    at_z[j] = z[j] + ahead * error[j]
            for j in range(J):
                q[j], v[j], z[j] = next_q[j], next_v[j], next_z[j]
    return DONE, T - 1


@compiled
def _rubbed(
    terms: Terms, h: float, tau: Floats, qd: Floats, work: Work, impulse: Floats, X: Floats, bound: Floats, v: Floats
) -> bool:
    """Fills v with the speeds a step h after qd, under work.M and work.load; False where M is not positive definite.

    Dry friction below zero, which estimates on the way may have, drives the arm: it is taken at the start of the step.
    """
    J = len(qd)
    for j in range(J):
        v[j] = tau[j] - work.load[j]
    for k in range(len(bound)):
        if terms.dry[k] < 0.0:
            size = terms.dry[k] * np.sign(row_speed(terms.rows, k, qd))
            for j in range(J):
                v[j] -= terms.rows[k, j] * size
    if not factor(work.M):
        return False
    solve(work.M, v)
    for j in range(J):
        v[j] = qd[j] + h * v[j]
    rub(work.M, terms.rows, bound, v, impulse, X)
    return True


@compiled
def _viscous_at_both_ends(terms: Terms, h: float, qd: Floats, speed: Floats, work: Work) -> None:
    """Takes viscous friction by the trapezoidal rule over a step from qd instead of at `speed`."""
    for j in range(len(qd)):
        for i in range(len(qd)):
            work.load[j] += terms.viscous[j, i] * (qd[i] - speed[i])
            work.M[j, i] += h / 2 * terms.viscous[j, i]


@compiled
def leapfrog(
    chain: Chain,
    terms: Terms,
    law: Law,
    model: Terms | None,
    path: Path,
    start: Floats,
    substeps: int,
    out: Floats,
) -> tuple[int, int]:
    """Drift half a step, kick with the forces of the middle, drift again; dry friction at the end of the kick.

    Arguments and result as `runge_kutta`. Viscous friction is taken by the trapezoidal rule. The acceleration at a
    sample is that of the forces there, over one step of friction.
    """
    T, J = path.q.shape
    K = len(terms.dry)
    h = path.step / substeps
    work, aim = workspace(J), Aim(np.empty(J), np.empty(J), np.empty(J))
    q, v, z, tau = start[0].copy(), start[1].copy(), np.zeros(J), np.zeros(J)
    middle, speed, next_v, mean = np.empty(J), np.empty(J), np.empty(J), np.zeros(J)
    sum_, rate = np.zeros(J), np.zeros(J)
    impulse, probe, X, bound = np.zeros(K), np.zeros(K), np.empty((K, J)), h * np.maximum(terms.dry, 0.0)
    seen, seen_speed = _remember(law, q, v, law.hold * h)
    for n in range(T):
        for s in range(substeps):
            if law.hold and (n * substeps + s) % law.hold == 0:
                look_ahead(path, n, s / substeps, aim)
                _sampled(law, model, chain, aim, q, v, seen, seen_speed, z, law.hold * h, work, speed, tau)
            if s == 0:
                if not law.hold:
                    look_ahead(path, n, 0.0, aim)
                    command(law, model, chain, aim, q, v, z, work, tau)
                probe[:] = impulse
                evaluate(chain, terms, q, v, work)
                if not _rubbed(terms, h, tau, v, work, probe, X, bound, next_v):
                    return _why(q, v, NOT_POSITIVE), n
                rate[:] = (next_v - v) / h
                _record(q, v, rate, tau, out[:, n])
                why = _why(q, v, DONE)
                if why != DONE or n == T - 1:
                    return why, n
            for j in range(J):
                middle[j] = q[j] + h / 2 * v[j]
                speed[j] = v[j] + h / 2 * mean[j]
            if not law.hold:
                look_ahead(path, n, (s + 0.5) / substeps, aim)
                integrate_error(law, aim, middle, rate)
                for j in range(J):
                    sum_[j] = z[j] + h / 2 * rate[j]
                    z[j] += h * rate[j]
                command(law, model, chain, aim, middle, speed, sum_, work, tau)
            evaluate(chain, terms, middle, speed, work)
            _viscous_at_both_ends(terms, h, v, speed, work)
            if not _rubbed(terms, h, tau, v, work, impulse, X, bound, next_v):
                return _why(q, v, NOT_POSITIVE), n
            for j in range(J):
                mean[j] = (next_v[j] - v[j]) / h
                v[j] = next_v[j]
                q[j] = middle[j] + h / 2 * v[j]
    return DONE, T - 1
