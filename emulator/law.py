"""Joint control laws in compiled code: PD and PID of Janot et al. 2014, eq. (19), and computed torque."""

from typing import NamedTuple

import numpy as np

from emulator.forward import Chain, Terms, Work, row_speed
from emulator.kernels import Floats, compiled, newton_euler, place


class Law(NamedTuple):
    """Arrays of `emulator.simulator.Control`.

    The model of computed torque is handed around beside it: None there makes compiled code without that branch.

    Attributes:
        turned: 1 where `axes` are not the joints.
        hold: Integration steps for which a torque is held; 0 for a law in continuous time.
        delay: Age of the positions that a torque is computed from, in periods.
        difference: 1 where speed is the difference of two positions over one period.
    """

    axes: Floats
    turned: int
    stiffness: Floats
    damping: Floats
    integral: Floats
    speed_weight: Floats
    limit: Floats
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
    J = len(q)
    for a in range(J):
        if not law.turned:
            rate[a] = aim.q[a] - q[a]
            continue
        rate[a] = 0.0
        for j in range(J):
            rate[a] += law.axes[a, j] * (aim.q[j] - q[j])


@compiled
def command(
    law: Law,
    model: Terms | None,
    chain: Chain,
    aim: Aim,
    q: Floats,
    qd: Floats,
    sum_: Floats,
    work: Work,
    tau: Floats,
) -> None:
    """Fills tau with the joint torques.

    Args:
        model: For computed torque: gains then make an acceleration, and the model the torque.
        sum_: Integral of the position errors, shape (J,).
    """
    J = len(q)
    axes, stiffness, damping, integral = law.axes, law.stiffness, law.damping, law.integral
    weight, limit, turned = law.speed_weight, law.limit, law.turned  # taken out once: each access of a tuple costs
    aim_q, aim_qd, u = aim.q, aim.qd, work.load  # load is free until the dynamics are evaluated
    for a in range(J):
        error, speed = aim_q[a] - q[a], weight[a] * aim_qd[a] - qd[a]
        if turned:
            error, speed = 0.0, 0.0
            for j in range(J):
                error += axes[a, j] * (aim_q[j] - q[j])
                speed += axes[a, j] * (weight[a] * aim_qd[j] - qd[j])
        u[a] = stiffness[a] * error + damping[a] * speed + integral[a] * sum_[a]
    if model is not None:
        _inverse_dynamics(model, chain, aim, q, qd, work, tau)
    for a in range(J):
        u[a] = min(max(u[a], -limit[a]), limit[a])
    for j in range(J):
        tau[j] = u[j]
        if turned:
            tau[j] = 0.0
            for a in range(J):
                tau[j] += axes[a, j] * u[a]


@compiled
def _inverse_dynamics(model: Terms, chain: Chain, aim: Aim, q: Floats, qd: Floats, work: Work, tau: Floats) -> None:
    """Turns the acceleration in work.load into the model's torque; tau is scratch.

    Dry friction is that of the reference, so it never chatters.
    """
    J, u = len(q), work.load
    for j in range(J):
        u[j] += aim.qdd[j]
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
    u[:] = tau
