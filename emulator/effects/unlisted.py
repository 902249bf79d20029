"""Physics outside the vocabulary, for blind trials alone: what `explain` must admit not to know.

No file or flag reaches these. Each is passive or conservative, and none is a case of a listed effect.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from emulator.kernels import Floats, Ints, compiled


class Form(IntEnum):
    """What it does; a, b are its numbers.

    FLUID: oil pressed through a throttle: torque a times the speed relaxed with the time constant b (Maxwell).
    THIXOTROPIC: grease that stiffens at rest: friction up to a, broken down over the distance b, rebuilt in 3 s.
    GROOVE: viscous friction a that comes and goes along the position, b periods per radian.
    CLUTCH: friction a that sets in above the speed b.
    TENDON: a tendon of stiffness a over the joint and b times the other joint.
    CHURNING: friction a per speed of the other joint: both stir one bath of oil.
    SAG: gravity-like torque a that depends on the double angle of the other joint.
    """

    FLUID = 1
    THIXOTROPIC = 2
    GROOVE = 3
    CLUTCH = 4
    TENDON = 5
    CHURNING = 6
    SAG = 7


_FLUID, _THIXOTROPIC, _GROOVE, _CLUTCH, _TENDON, _CHURNING, _SAG = (int(form) for form in Form)
_REBUILD_S = 3.0
_SHARP = 0.01  # of a speed scale over which a sign is smoothed


class Unlisted(NamedTuple):
    """Constants, shape (P,).

    Attributes:
        form, joint, other: Joints from 0.
        a, b: Numbers of the form.
        speed: Largest speed of the joint: scale of smoothed signs.
    """

    form: Ints
    joint: Ints
    other: Ints
    a: Floats
    b: Floats
    speed: Floats


@compiled
def act_unlisted(unlisted: Unlisted, memory: Floats, q: Floats, qd: Floats, first: int, h: float, kick: Floats) -> None:
    """Adds all torques.

    Args:
        memory: One hidden state each, shape (P,).
        q, qd: Of the joints.
        first: Coordinate of the first joint.
    """
    for p in range(len(unlisted.form)):
        form, j, other = unlisted.form[p], unlisted.joint[p], unlisted.other[p]
        a, b, v = unlisted.a[p], unlisted.b[p], qd[j]
        sign = np.tanh(v / (_SHARP * unlisted.speed[p]))
        torque = 0.0
        if form == _FLUID:
            memory[p] += (1.0 - np.exp(-h / b)) * (v - memory[p])
            torque = a * memory[p]
        elif form == _THIXOTROPIC:
            memory[p] += h * ((1.0 - memory[p]) / _REBUILD_S - memory[p] * abs(v) / b)
            torque = a * memory[p] * sign
        elif form == _GROOVE:
            torque = a * (1.0 + np.sin(b * q[j])) * v
        elif form == _CLUTCH:
            torque = a * sign / (1.0 + np.exp(-(abs(v) - b) / (0.05 * b)))
        elif form == _TENDON:
            torque = a * (q[j] + b * q[other])
            kick[first + other] -= b * torque
        elif form == _CHURNING:
            torque = a * abs(qd[other]) * sign
        elif form == _SAG:  # gradient of a potential over both joints
            torque = a * np.sin(2.0 * q[other]) * np.cos(q[j])
            kick[first + other] -= 2.0 * a * np.cos(2.0 * q[other]) * np.sin(q[j])
        kick[first + j] -= torque
