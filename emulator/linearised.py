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
    """Coefficients of one interval: M S'' + D S' + K S = -W and what a sampled law adds; scratch. Shape (J, J) each.

    Attributes:
        by_q, by_qd: Of a continuous or sampled law by the state that it sees: torque = -by_q S - by_qd S' - by_z Z.
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
def _control(chain: Chain, law: Law, q: Floats, qd: Floats, qdd: Floats, free: Floats, x: Bodies, step: Step) -> None:
    """Fills step.by_q, by_qd, by_z; computed torque is linearised where the arm does what it is told."""
    J = len(q)
    by_q, by_qd, by_z = step.by_q, step.by_qd, step.by_z
    if law.inverse:
        _mechanics(chain, law.model, q, qd, qdd, x, step.A, by_q, by_qd)
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

    A row that ends at rest keeps nothing. A speed that jumps through zero keeps a'/(a' + 2 Fc m), a' being its
    acceleration afterwards and m its mobility: the derivative of when it happens. Smooth friction has a slope.
    """
    J = A.shape[0]
    for k in range(len(terms.dry)):
        if terms.dry[k] <= 0.0:
            continue
        before, after = row_speed(terms.rows, k, loop.qd[n]), row_speed(terms.rows, k, loop.qd[n + 1])
        size = 0.0
        if np.isfinite(steepness[k]):
            s = steepness[k]
            if abs(s * (after - before)) > 1e-6:
                size = loop.step * terms.dry[k] * (np.tanh(s * after) - np.tanh(s * before)) / (after - before)
            else:
                size = loop.step * terms.dry[k] * s / np.cosh(min(abs(s * after), 300.0)) ** 2
        elif abs(after) <= 10.0 * STANDING:
            size = _LOCK
        elif before * after < 0.0:
            rate = row_speed(terms.rows, k, loop.qdd[n + 1]) * np.sign(after)
            size = _LOCK if rate <= 2.0 * terms.dry[k] / _LOCK else 2.0 * terms.dry[k] / rate
        if size != 0.0:
            for j in range(J):
                for i in range(J):
                    A[j, i] += size * terms.rows[k, j] * terms.rows[k, i]


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
def propagate(
    chain: Chain, terms: Terms, law: Law, loop: Loop, steepness: Floats, W: Floats, out_q: Floats, out_tau: Floats
) -> None:
    """Fills the sensitivities of positions and torques, shape (J, T, P) each, by the trapezoidal rule.

    Args:
        law: With `hold` in samples.
        W: Regressor at the middle of the intervals, shape (J, T - 1, P).
    """
    T, J = loop.q.shape
    P, h = W.shape[2], loop.step
    x = bodies(J)
    step = Step(
        np.empty((J, J)),
        np.empty((J, J)),
        np.empty((J, J)),
        np.empty((J, J)),
        np.empty((J, J)),
        np.empty((J, J)),
        np.empty((J, J)),
        np.empty((J, J)),
    )
    q, v, a = np.empty(J), np.empty(J), np.empty(J)
    S, V, Z, new, tau = np.zeros((J, P)), np.zeros((J, P)), np.zeros((J, P)), np.empty((J, P)), np.zeros((J, P))
    seen, seen_speed = np.zeros((law.delay + 2, J, P)), np.zeros((law.delay + 2, J, P))
    for n in range(T):
        if law.hold:
            if n % law.hold == 0:
                _control(chain, law, loop.q[n], loop.qd[n], loop.qdd[n], loop.free[n], x, step)
                _answer(law, step, h, S, V, Z, seen, seen_speed, tau)
        elif n == T - 1:
            _control(chain, law, loop.q[n], loop.qd[n], loop.qdd[n], loop.free[n], x, step)
        if n < T - 1:
            for j in range(J):
                q[j] = (loop.q[n, j] + loop.q[n + 1, j]) / 2
                v[j] = (loop.qd[n, j] + loop.qd[n + 1, j]) / 2
                a[j] = (loop.qd[n + 1, j] - loop.qd[n, j]) / h
            if not law.hold:
                _control(chain, law, q, v, a, loop.free[n], x, step)
                step.by_qd[:, :] -= loop.lag * step.by_q
        if not law.hold:
            tau[:, :] = 0.0
            _add_product(-1.0, step.by_q, S, tau)
            _add_product(-1.0, step.by_qd, V, tau)
            _add_product(-1.0, step.by_z, Z, tau)
        for j in range(J):
            out_q[j, n, :] = S[j]
            out_tau[j, n, :] = tau[j]
        if n == T - 1:
            return
        _mechanics(chain, terms, q, v, a, x, step.M, step.K, step.D)
        for j in range(J):
            new[j, :] = -h * W[j, n]
        if law.hold:
            for j in range(J):
                for c in range(P):
                    new[j, c] += h * tau[j, c]
        else:
            step.K[:, :] += step.by_q
            step.D[:, :] += step.by_qd
            _add_product(-h, step.by_z, Z, new)
        for j in range(J):
            for i in range(J):
                far = h / 2 * step.D[j, i] + h * h / 4 * step.K[j, i]
                step.A[j, i] = step.M[j, i] + far
                step.X[j, i] = step.M[j, i] - far
        _dry(terms, steepness, loop, n, step.A)
        _add_product(1.0, step.X, V, new)
        _add_product(-h, step.K, S, new)
        _solve(step.A, new)
        for j in range(J):
            for c in range(P):
                change = h / 2 * (V[j, c] + new[j, c])
                if not law.hold:
                    Z[j, c] += h * (S[j, c] + change / 2)
                S[j, c] += change
                V[j, c] = new[j, c]


@compiled
def _answer(
    law: Law,
    step: Step,
    h: float,
    S: Floats,
    V: Floats,
    Z: Floats,
    seen: Floats,
    seen_speed: Floats,
    tau: Floats,
) -> None:
    """One instant of a sampled law: takes in S and S', fills tau; as `closed_loop._sampled`."""
    for k in range(len(seen) - 1, 0, -1):
        seen[k] = seen[k - 1]
        seen_speed[k] = seen_speed[k - 1]
    seen[0] = S
    seen_speed[0] = V
    period = law.hold * h
    Z += period * seen[law.delay]
    tau[:, :] = 0.0
    _add_product(-1.0, step.by_q, seen[law.delay], tau)
    _add_product(-1.0, step.by_z, Z, tau)
    if law.difference:
        _add_product(-1.0 / period, step.by_qd, seen[law.delay], tau)
        _add_product(1.0 / period, step.by_qd, seen[law.delay + 1], tau)
    else:
        _add_product(-1.0, step.by_qd, seen_speed[law.delay], tau)
