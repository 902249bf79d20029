"""Torque of the motors: saturating torque constant, cogging and torque ripple.

Saturation as tanh of the current, the usual fit of flux-linkage curves (e.g. Qu, Tuovinen & Hinkkanen 2012 use
other powers); cogging in harmonics of the motor angle, which is conservative; ripple of the torque constant grows
with current (Holtz & Springob 1996).
"""

from typing import NamedTuple

import numpy as np

from emulator.kernels import Floats, Ints, compiled


class Motors(NamedTuple):
    """Constants.

    Attributes:
        knee_A: Current scale of saturation per motor, 0 where there is none, shape (J,).
        motor: Of each ripple, shape (P,).
        per_rad: Periods times 2 pi per joint-side radian of the motor, signed.
        amplitude, phase, second, second_phase, per_A: First and second harmonic; amplitude per ampere.
    """

    knee_A: Floats
    motor: Ints
    per_rad: Floats
    amplitude: Floats
    phase: Floats
    second: Floats
    second_phase: Floats
    per_A: Floats


@compiled
def motor_torques(motors: Motors, gain: Floats, current: Floats, angle: Floats, torque: Floats) -> None:
    """Fills torque, shape (J,) [N·m, joint side].

    Args:
        gain: True torque per ampere, signed.
        angle: Motor angles on the joint side.
    """
    for j in range(len(current)):
        knee = motors.knee_A[j]
        torque[j] = gain[j] * (knee * np.tanh(current[j] / knee) if knee > 0.0 else current[j])
    for p in range(len(motors.motor)):
        j = motors.motor[p]
        turn = motors.per_rad[p] * angle[j]
        torque[j] += (motors.amplitude[p] + motors.per_A[p] * current[j]) * np.sin(turn + motors.phase[p])
        torque[j] += motors.second[p] * np.sin(2 * turn + motors.second_phase[p])


def knee_of(loss: float, current_A: float) -> float:
    """Current scale s at which s tanh(i/s) misses a share `loss` of i at `current_A`."""
    low, high = 1e-3, 1e6  # of current / s
    for _ in range(100):
        x = np.sqrt(low * high)
        if 1 - np.tanh(x) / x < loss:
            low = x
        else:
            high = x
    return float(current_A / np.sqrt(low * high))
