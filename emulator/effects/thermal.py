"""Temperature of the lubricant of each joint: a body warmed by friction and by the motor, seen by a slow sensor.

First-order thermal network as fitted to robot joints by Simoni et al. 2015 and Bittencourt & Axelsson 2014.
"""

from typing import NamedTuple

from emulator.kernels import Floats, compiled

MOTOR_SHARE = 0.5  # of the winding's rise above ambient that reaches the lubricant through flange and shaft


class Thermal(NamedTuple):
    """Constants, shape (J,).

    Attributes:
        warming: Share of its way to the steady state that the lubricant goes in a period; 0: it is not simulated.
        rise_K_W: Steady state above ambient per watt of friction.
        sensing: Share of its way to the lubricant's temperature that the sensor goes in a period.
    """

    warming: Floats
    rise_K_W: Floats
    sensing: Floats


class Warm(NamedTuple):
    """State, shape (J,).

    Attributes:
        lubricant_C: What friction depends on.
        shown_C: What the cell's sensors say: lubricant where it is simulated, else the winding.
        loss_W: Friction power, mean over the period.
    """

    lubricant_C: Floats
    shown_C: Floats
    loss_W: Floats


@compiled
def warm_up(thermal: Thermal, warm: Warm, winding_C: Floats, ambient_C: float) -> None:
    """One period of all lubricants and sensors."""
    for j in range(len(winding_C)):
        if thermal.warming[j] == 0.0:
            warm.shown_C[j] = winding_C[j]
            continue
        steady = ambient_C + thermal.rise_K_W[j] * warm.loss_W[j] + MOTOR_SHARE * (winding_C[j] - ambient_C)
        warm.lubricant_C[j] += thermal.warming[j] * (steady - warm.lubricant_C[j])
        warm.shown_C[j] += thermal.sensing[j] * (warm.lubricant_C[j] - warm.shown_C[j])
