"""Joint control laws in compiled code: PD and PID of Janot et al. 2014, eq. (19), and computed torque."""

from typing import NamedTuple

import numpy as np

from emulator.forward import Chain, Terms, Work, row_speed
from emulator.kernels import Floats, compiled, newton_euler, place


class Law(NamedTuple):
    """Arrays of `emulator.simulator.Control`.

    Attributes:
        inverse: 1 for computed torque: gains then make an acceleration, and `model` the torque.
        hold: Integration steps for which a torque is held; 0 for a law in continuous time.
        delay: Age of the positions that a torque is computed from, in periods.
        difference: 1 where speed is the difference of two positions over one period.
    """

    axes: Floats
    stiffness: Floats
    damping: Floats
    integral: Floats
    speed_weight: Floats
    limit: Floats
    model: Terms
    inverse: int
    hold: int
    delay: int
    difference: int


class Aim(NamedTuple):
    """Reference at one instant, shape (J,) each."""

    q: Floats
    qd: Floats
    qdd: Floats


class Path(NamedTuple):
    """Reference on a regular grid: q, qd, qdd of shape (T, J), step [s]."""

    q: Floats
    qd: Floats
    qdd: Floats
    step: float


@compiled
def look_ahead(path: Path, n: int, x: float, aim: Aim) -> None:
    """Reference a share x of the way from sample n to the next: cubic in position, straight in its derivatives."""
    q, qd, qdd, step = path
    J = q.shape[1]
    if x == 0.0:
        for j in range(J):
            aim.q[j], aim.qd[j], aim.qdd[j] = q[n, j], qd[n, j], qdd[n, j]
        return
    y = 1.0 - x
    for j in range(J):
        rise = q[n + 1, j] - q[n, j]
        bend = y * (step * qd[n, j] - rise) + x * (rise - step * qd[n + 1, j])
        aim.q[j] = q[n, j] + x * (rise + y * bend)
        aim.qd[j] = y * qd[n, j] + x * qd[n + 1, j]
        aim.qdd[j] = y * qdd[n, j] + x * qdd[n + 1, j]


@compiled
def integrate_error(law: Law, aim: Aim, q: Floats, rate: Floats) -> None:
    """Fills rate with the position errors on the axes of the law, shape (J,)."""
    for a in range(len(q)):
        rate[a] = 0.0
        for j in range(len(q)):
            rate[a] += law.axes[a, j] * (aim.q[j] - q[j])


@compiled
def command(law: Law, chain: Chain, aim: Aim, q: Floats, qd: Floats, sum_: Floats, work: Work, tau: Floats) -> None:
    """Fills tau with the joint torques.

    Args:
        sum_: Integral of the position errors, shape (J,).
    """
    J = len(q)
    u = work.load  # free until the dynamics are evaluated
    for a in range(J):
        u[a] = law.integral[a] * sum_[a]
        for j in range(J):
            u[a] += law.axes[a, j] * (
                law.stiffness[a] * (aim.q[j] - q[j]) + law.damping[a] * (law.speed_weight[a] * aim.qd[j] - qd[j])
            )
    if law.inverse:
        for j in range(J):
            u[j] += aim.qdd[j]
        _inverse_dynamics(law.model, chain, aim, q, qd, u, work, tau)
        for j in range(J):
            tau[j] = min(max(tau[j], -law.limit[j]), law.limit[j])
        return
    for a in range(J):
        u[a] = min(max(u[a], -law.limit[a]), law.limit[a])
    for j in range(J):
        tau[j] = 0.0
        for a in range(J):
            tau[j] += law.axes[a, j] * u[a]


@compiled
def _inverse_dynamics(
    model: Terms, chain: Chain, aim: Aim, q: Floats, qd: Floats, u: Floats, work: Work, tau: Floats
) -> None:
    """Torque that gives the model the acceleration u; dry friction is that of the reference, so it never chatters."""
    J = len(q)
    place(chain.R0, chain.p0, chain.prismatic, q, work.R, work.p)
    newton_euler(work.R, work.p, chain.prismatic, chain.gravity, model.link, qd, u, tau, work.f, work.n)
    for j in range(J):
        tau[j] += model.offset[j]
        for i in range(J):
            tau[j] += model.rotor[j, i] * u[i] + model.viscous[j, i] * qd[i]
    for k in range(len(model.dry)):
        speed = row_speed(model.rows, k, aim.qd)
        size = model.dry[k] * np.sign(speed) + model.skew[k] * abs(speed)
        for j in range(J):
            tau[j] += model.rows[k, j] * size
