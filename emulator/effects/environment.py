"""What acts on the joints from outside: springs and hoses, an obstacle that appears once, torques periodic in time.

The obstacle is elastic up to the torque at which it gives way, then it is pushed along (elastoplastic, so it only
takes energy), and it never pulls.
"""

from typing import NamedTuple

import numpy as np

from emulator.kernels import Floats, Ints, compiled


class Environment(NamedTuple):
    """Constants.

    Attributes:
        spring: Joints of the springs, shape (P,); stiffness, centre, cubic, and displacement from which each
            stiffens (0: never).
        obstacle: Joints of the obstacles, shape (Q,); first and last time, stiffness, torque at which it yields.
        hum: Joints of the periodic torques, shape (S,); amplitude, angular frequency, phase.
    """

    spring: Ints
    stiffness: Floats
    centre: Floats
    cubic: Floats
    progressive: Floats
    obstacle: Ints
    appears_s: Floats
    leaves_s: Floats
    hardness: Floats
    yields_Nm: Floats
    hum: Ints
    amplitude: Floats
    rad_s: Floats
    phase: Floats


class Touched(NamedTuple):
    """State of the obstacles, shape (Q,): where they stand, and on which side (0: not there)."""

    place: Floats
    side: Floats


@compiled
def act(
    environment: Environment,
    touched: Touched,
    t_s: float,
    q: Floats,
    qd: Floats,
    first: int,
    h: float,
    kick: Floats,
    A: Floats,
) -> None:
    """Adds all torques.

    Args:
        q, qd: Of the joints.
        first: Coordinate of the first joint.
    """
    for p in range(len(environment.spring)):
        j = environment.spring[p]
        x = q[j] - environment.centre[p]
        pull = environment.stiffness[p] * x + environment.cubic[p] * x**3
        if environment.progressive[p] > 0.0:
            pull += environment.stiffness[p] * x * (np.sqrt(1.0 + (x / environment.progressive[p]) ** 2) - 1.0)
        kick[first + j] -= pull
    for p in range(len(environment.hum)):
        turn = environment.rad_s[p] * t_s + environment.phase[p]
        kick[first + environment.hum[p]] += environment.amplitude[p] * np.sin(turn)
    for p in range(len(environment.obstacle)):
        j = environment.obstacle[p]
        if not environment.appears_s[p] <= t_s < environment.leaves_s[p]:
            touched.side[p] = 0.0
            continue
        if touched.side[p] == 0.0:
            touched.side[p] = 1.0 if qd[j] >= 0.0 else -1.0
            touched.place[p] = q[j]
        side = touched.side[p]
        push = environment.hardness[p] * side * (q[j] - touched.place[p])
        if push <= 0.0:
            continue
        if push > environment.yields_Nm[p]:
            push = environment.yields_Nm[p]
            touched.place[p] = q[j] - side * push / environment.hardness[p]
        else:
            A[first + j, first + j] += h * h / 4 * environment.hardness[p]
        kick[first + j] -= side * push
