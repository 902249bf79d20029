"""Elastic transmissions with play: two masses, the rotor with its friction and encoder before the spring.

Spong 1987 for the flexible joint; hardening of harmonic drives as a cubic spring (Tuttle & Seering 1996); play as the
physical dead zone of Nordin & Gutman 2002, whose flanks push and never pull.
"""

from typing import NamedTuple

from emulator.effects.friction import add_outer
from emulator.kernels import Floats, Ints, compiled


class Shafts(NamedTuple):
    """Constants, one entry per elastic axis.

    Attributes:
        motor: Which motor, shape (E,).
        rotor: Its coordinate, shape (E,).
        twist: Rows of the twist over all coordinates: rotor minus C q, shape (E, n).
        inertia: Of the rotor on the joint side [kg·m²].
        stiffness, cubic, damping: [N·m/rad], [N·m/rad³], [N·m·s/rad].
        gap: Free travel from flank to flank [rad].
        of_motor: Elastic axis of each motor, -1 where it is rigid, shape (J,).
    """

    motor: Ints
    rotor: Ints
    twist: Floats
    inertia: Floats
    stiffness: Floats
    cubic: Floats
    damping: Floats
    gap: Floats
    of_motor: Ints


@compiled
def transmit(shafts: Shafts, middle: Floats, start: Floats, h: float, kick: Floats, A: Floats, load: Floats) -> None:
    """Adds the torques of all shafts; fills `load` of their motors.

    Args:
        middle: Coordinates in the middle of the substep, shape (n,).
        start: Speeds at its start, shape (n,).
        load: Torque transmitted by each motor, shape (J,).
    """
    for e in range(len(shafts.motor)):
        twist, rate = 0.0, 0.0
        for i in range(len(middle)):
            twist += shafts.twist[e, i] * middle[i]
            rate += shafts.twist[e, i] * start[i]
        half = shafts.gap[e] / 2
        pressed = twist - half if twist > half else (twist + half if twist < -half else 0.0)
        torque = 0.0
        if half == 0.0 or pressed != 0.0:
            torque = shafts.stiffness[e] * pressed + shafts.cubic[e] * pressed**3 + shafts.damping[e] * rate
            if half == 0.0 or torque * pressed > 0.0:
                slope = shafts.stiffness[e] + 3 * shafts.cubic[e] * pressed**2
                add_outer(A, shafts.twist[e], h * h / 4 * slope + h / 2 * shafts.damping[e])
            else:  # the flank leaves faster than the spring follows
                torque = 0.0
        load[shafts.motor[e]] = torque
        for i in range(len(kick)):
            kick[i] -= shafts.twist[e, i] * torque
