"""Direct dynamic model (10) of Janot et al. 2014 in compiled code: M(q) qdd = tau - N(q, qd).

M holds the links and the rotors, N the links' centrifugal, Coriolis and gravity torques, viscous friction and offsets.
Dry friction is left to the integrator. Everything is linear in the parameters, which may be those of no body: only M
must be positive definite.
"""

from typing import NamedTuple

import numpy as np

from emulator.friction import factor, solve
from emulator.kernels import Floats, Ints, compiled, composite_inertia, newton_euler, place


class Chain(NamedTuple):
    """Arrays of `protocols.robot.Geometry`."""

    R0: Floats
    p0: Floats
    prismatic: Ints
    gravity: Floats


class Terms(NamedTuple):
    """Arrays of `emulator.simulator.Dynamics`."""

    link: Floats
    rotor: Floats
    viscous: Floats
    offset: Floats
    rows: Floats
    dry: Floats
    skew: Floats


class Work(NamedTuple):
    """Scratch of one evaluation."""

    R: Floats
    p: Floats
    f: Floats
    n: Floats
    M: Floats
    whole: Floats
    rest: Floats
    load: Floats


@compiled
def workspace(J: int) -> Work:
    return Work(
        np.empty((J, 3, 3)),
        np.empty((J, 3)),
        np.empty((J, 3)),
        np.empty((J, 3)),
        np.empty((J, J)),
        np.empty((J, 10)),
        np.zeros(J),
        np.empty(J),
    )


@compiled
def row_speed(rows: Floats, k: int, qd: Floats) -> float:
    value = 0.0
    for j in range(len(qd)):
        value += rows[k, j] * qd[j]
    return value


@compiled
def evaluate(chain: Chain, terms: Terms, q: Floats, qd: Floats, work: Work) -> None:
    """Fills work.M with M(q) and work.load with N(q, qd)."""
    J = len(q)
    R, p, M, load = work.R, work.p, work.M, work.load  # taken out once: each access of a tuple costs
    link, rotor, viscous, offset, rows, skew = (
        terms.link,
        terms.rotor,
        terms.viscous,
        terms.offset,
        terms.rows,
        terms.skew,
    )
    place(chain.R0, chain.p0, chain.prismatic, q, R, p)
    newton_euler(R, p, chain.prismatic, chain.gravity, link, qd, work.rest, load, work.f, work.n)
    composite_inertia(R, p, chain.prismatic, link, M, work.whole)
    for j in range(J):
        load[j] += offset[j]
        for i in range(J):
            M[j, i] += rotor[j, i]
            load[j] += viscous[j, i] * qd[i]
    for k in range(len(skew)):
        if skew[k] != 0.0:
            size = skew[k] * abs(row_speed(rows, k, qd))
            for j in range(J):
                load[j] += rows[k, j] * size


@compiled
def smooth_acceleration(
    chain: Chain, terms: Terms, steepness: Floats, q: Floats, qd: Floats, tau: Floats, work: Work, qdd: Floats
) -> bool:
    """Fills qdd with dry friction as dry * tanh(steepness * speed); False where M is not positive definite."""
    J = len(q)
    evaluate(chain, terms, q, qd, work)
    for j in range(J):
        qdd[j] = tau[j] - work.load[j]
    for k in range(len(terms.dry)):
        if terms.dry[k] != 0.0:
            size = terms.dry[k] * np.tanh(steepness[k] * row_speed(terms.rows, k, qd))
            for j in range(J):
                qdd[j] -= terms.rows[k, j] * size
    if not factor(work.M):
        return False
    solve(work.M, qdd)
    return True
