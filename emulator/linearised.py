"""Linearised closed loop along a simulated motion, in compiled code."""

from typing import NamedTuple

import numpy as np

from emulator.closed_loop import STANDING
from emulator.derivatives import Bodies, bodies, inverse_dynamics_derivatives
from emulator.forward import Chain, Terms, row_speed
from emulator.kernels import Floats, compiled
from emulator.law import Law

_LOCK = 1e6  # kg·m², friction that lets a row keep a millionth of any change of its speed


class Loop(NamedTuple):
    """A simulated motion.

    Attributes:
        q, qd, qdd: At the samples, shape (T, J).
        free: 1 where an axis of the law is not at its limit, shape (T, J).
        step: Of the samples [s].
        lag: Delay of a law taken as continuous [s].
    """

    q: Floats
    qd: Floats
    qdd: Floats
    free: Floats
    step: float
    lag: float


class Step(NamedTuple):
    """Coefficients of one interval, M S'' + D S' + K S = tau - W with tau = -by_q S - by_qd S' - by_z Z; shape (J, J).

    Attributes:
        A, X: Scratch; A starts with what dry friction takes.
    """

    M: Floats
    K: Floats
    D: Floats
    by_q: Floats
    by_qd: Floats
    by_z: Floats
    A: Floats
    X: Floats


@compiled
def _mechanics(
    chain: Chain, terms: Terms, q: Floats, qd: Floats, qdd: Floats, x: Bodies, M: Floats, K: Floats, D: Floats
) -> None:
    """Fills M, K and D with the model's inertia and derivatives, without dry friction."""
    J = len(q)
    inverse_dynamics_derivatives(chain, terms.link, q, qd, qdd, x, M, K, D)
    M += terms.rotor
    D += terms.viscous
    for k in range(len(terms.skew)):
        if terms.skew[k] != 0.0:
            slope = terms.skew[k] * np.sign(row_speed(terms.rows, k, qd))
            for j in range(J):
                for i in range(J):
                    D[j, i] += slope * terms.rows[k, j] * terms.rows[k, i]


@compiled
def _control(
    chain: Chain,
    law: Law,
    model: Terms | None,
    q: Floats,
    qd: Floats,
    qdd: Floats,
    free: Floats,
    x: Bodies,
    step: Step,
) -> None:
    """Fills step.by_q, by_qd, by_z; computed torque is linearised where the arm does what it is told."""
    J = len(q)
    by_q, by_qd, by_z = step.by_q, step.by_qd, step.by_z
    if model is not None:
        _mechanics(chain, model, q, qd, qdd, x, step.A, by_q, by_qd)
        for j in range(J):
            for i in range(J):
                inertia = free[j] * step.A[j, i]
                by_q[j, i] = inertia * law.stiffness[i] - free[j] * by_q[j, i]
                by_qd[j, i] = inertia * law.damping[i] - free[j] * by_qd[j, i]
                by_z[j, i] = inertia * law.integral[i]
        return
    by_q[:, :] = 0.0
    by_qd[:, :] = 0.0
    by_z[:, :] = 0.0
    for k in range(J):
        for j in range(J):
            for i in range(J):
                share = free[k] * law.axes[k, j] * law.axes[k, i]
                by_q[j, i] += share * law.stiffness[k]
                by_qd[j, i] += share * law.damping[k]
                by_z[j, i] += share * law.integral[k]


@compiled
def _dry(terms: Terms, steepness: Floats, loop: Loop, n: int, A: Floats) -> None:
    """Adds to A what the dry friction of the interval after sample n takes of a change of speed.

    A row that ends at rest keeps nothing. A speed that jumps through zero keeps a/(a + 2 Fc m), with its acceleration a
    afterwards and its mobility m: the derivative of when it happens. Smooth friction has a slope.
    """
    J = A.shape[0]
    for k in range(len(terms.dry)):
        if terms.dry[k] <= 0.0:
            continue
        before, after, rate = 0.0, 0.0, 0.0
        for j in range(J):
            before += terms.rows[k, j] * loop.qd[n, j]
            after += terms.rows[k, j] * loop.qd[n + 1, j]
            rate += terms.rows[k, j] * loop.qdd[n + 1, j]
        size = 0.0
        if np.isfinite(steepness[k]):
            size = loop.step * terms.dry[k] * _slope(steepness[k], before, after)
        elif abs(after) <= 10.0 * STANDING:
            size = _LOCK
        elif before * after < 0.0:
            size = min(_LOCK, 2.0 * terms.dry[k] / max(rate * np.sign(after), 1e-300))
        if size != 0.0:
            for j in range(J):
                for i in range(J):
                    A[j, i] += size * terms.rows[k, j] * terms.rows[k, i]


@compiled
def _slope(steepness: float, before: float, after: float) -> float:
    """Mean slope of tanh(steepness * speed) between two speeds."""
    high, low = np.tanh(steepness * after), np.tanh(steepness * before)
    slope: float = steepness * (1.0 - high**2)
    if abs(steepness * (after - before)) > 1e-6:
        slope = (high - low) / (after - before)
    return slope


@compiled
def _add_product(factor: float, A: Floats, x: Floats, out: Floats) -> None:
    """out += factor A x, for A of shape (J, J) and x of shape (J, P)."""
    for j in range(A.shape[0]):
        for i in range(A.shape[1]):
            share = factor * A[j, i]
            if share != 0.0:
                for c in range(x.shape[1]):
                    out[j, c] += share * x[i, c]


@compiled
def _add_all(factor: float, x: Floats, out: Floats) -> None:
    """out += factor x."""
    for j in range(x.shape[0]):
        for c in range(x.shape[1]):
            out[j, c] += factor * x[j, c]


@compiled
def _solve(A: Floats, x: Floats) -> None:
    """x = inv(A) x by elimination in place; A is near a positive definite matrix, so it needs no pivots."""
    J, P = x.shape
    for k in range(J):
        inverse = 1.0 / A[k, k]
        for j in range(k + 1, J):
            share = A[j, k] * inverse
            if share != 0.0:
                for i in range(k + 1, J):
                    A[j, i] -= share * A[k, i]
                for c in range(P):
                    x[j, c] -= share * x[k, c]
    for k in range(J - 1, -1, -1):
        for i in range(k + 1, J):
            share = A[k, i]
            if share != 0.0:
                for c in range(P):
                    x[k, c] -= share * x[i, c]
        inverse = 1.0 / A[k, k]
        for c in range(P):
            x[k, c] *= inverse


@compiled
def _step(J: int) -> Step:
    return Step(
        np.empty((J, J)),
        np.empty((J, J)),
        np.empty((J, J)),
        np.empty((J, J)),
        np.empty((J, J)),
        np.empty((J, J)),
        np.empty((J, J)),
        np.empty((J, J)),
    )


class Columns(NamedTuple):
    """One column per parameter, shape (J, P) each.

    Attributes:
        S, V: Sensitivities of position and speed.
        Z: Of the integral of the position errors, with its sign turned.
        tau: Of the torque.
        new: Scratch.
        seen, seen_speed: S and V at the last instants of a sampled law in turn, shape (delay + 2, J, P).
    """

    S: Floats
    V: Floats
    Z: Floats
    tau: Floats
    new: Floats
    seen: Floats
    seen_speed: Floats


@compiled
def _columns(J: int, P: int, depth: int) -> Columns:
    return Columns(
        np.zeros((J, P)),
        np.zeros((J, P)),
        np.zeros((J, P)),
        np.zeros((J, P)),
        np.zeros((J, P)),
        np.zeros((depth, J, P)),
        np.zeros((depth, J, P)),
    )


@compiled
def _answer_now(step: Step, x: Columns) -> None:
    """Fills tau for a law in continuous time."""
    x.tau[:, :] = 0.0
    _add_product(-1.0, step.by_q, x.S, x.tau)
    _add_product(-1.0, step.by_qd, x.V, x.tau)
    _add_product(-1.0, step.by_z, x.Z, x.tau)


@compiled
def _answer_sampled(law: Law, step: Step, period: float, instant: int, x: Columns) -> None:
    """Fills tau at one instant of a sampled law; as `closed_loop._sampled`."""
    depth = law.delay + 2
    x.seen[instant % depth, :, :] = x.S
    x.seen_speed[instant % depth, :, :] = x.V
    now = (instant - law.delay) % depth
    last, before = x.seen[now], x.seen[now - 1]
    _add_all(period, last, x.Z)
    x.tau[:, :] = 0.0
    _add_product(-1.0, step.by_q, last, x.tau)
    _add_product(-1.0, step.by_z, x.Z, x.tau)
    if law.difference:
        _add_product(-1.0 / period, step.by_qd, last, x.tau)
        _add_product(1.0 / period, step.by_qd, before, x.tau)
    else:
        _add_product(-1.0, step.by_qd, x.seen_speed[now], x.tau)


@compiled
def _advance(step: Step, h: float, held: bool, x: Columns) -> None:
    """One interval by the trapezoidal rule; `x.new` holds -h W and becomes the speed at its end.

    Args:
        held: Torque does not change in the interval.
    """
    J, P = x.S.shape
    if held:
        _add_all(h, x.tau, x.new)
    else:
        step.K[:, :] += step.by_q
        step.D[:, :] += step.by_qd
        _add_product(-h, step.by_z, x.Z, x.new)
    for j in range(J):
        for i in range(J):
            far = h / 2 * step.D[j, i] + h * h / 4 * step.K[j, i]
            step.A[j, i] += step.M[j, i] + far
            step.X[j, i] = step.M[j, i] - far
    _add_product(1.0, step.X, x.V, x.new)
    _add_product(-h, step.K, x.S, x.new)
    _solve(step.A, x.new)
    for j in range(J):
        for c in range(P):
            change = h / 2 * (x.V[j, c] + x.new[j, c])
            if not held:
                x.Z[j, c] += h * (x.S[j, c] + change / 2)
            x.S[j, c] += change
            x.V[j, c] = x.new[j, c]


@compiled
def propagate(
    chain: Chain,
    terms: Terms,
    law: Law,
    model: Terms | None,
    loop: Loop,
    steepness: Floats,
    W: Floats,
    out_q: Floats,
    out_tau: Floats,
) -> None:
    """Fills the sensitivities of positions and torques, shape (J, T, P) each.

    Args:
        law: With `hold` in samples.
        W: Regressor at the middle of the intervals, shape (J, T - 1, P).
    """
    T, J = loop.q.shape
    P, h = W.shape[2], loop.step
    body, step, x = bodies(J), _step(J), _columns(J, P, law.delay + 2)
    q, qd, qdd = np.empty(J), np.empty(J), np.empty(J)
    for n in range(T):
        if not law.hold or n % law.hold == 0:
            _control(chain, law, model, loop.q[n], loop.qd[n], loop.qdd[n], loop.free[n], body, step)
            step.by_qd[:, :] -= loop.lag * step.by_q
            if law.hold:
                _answer_sampled(law, step, law.hold * h, n // law.hold, x)
        if not law.hold:
            _answer_now(step, x)
        for j in range(J):
            out_q[j, n, :] = x.S[j]
            out_tau[j, n, :] = x.tau[j]
        if n == T - 1:
            return
        for j in range(J):
            q[j] = (loop.q[n, j] + loop.q[n + 1, j]) / 2
            qd[j] = (loop.qd[n, j] + loop.qd[n + 1, j]) / 2
            qdd[j] = (loop.qd[n + 1, j] - loop.qd[n, j]) / h
            x.new[j, :] = -h * W[j, n]
        _mechanics(chain, terms, q, qd, qdd, body, step.M, step.K, step.D)
        step.A[:, :] = 0.0
        _dry(terms, steepness, loop, n, step.A)
        _advance(step, h, law.hold > 0, x)
