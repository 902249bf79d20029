"""What the drive and the encoder say of the motor: current loops with an offset, delayed currents, eccentric discs.

An eccentric disc read by one head turns by atan2(e sin a, 1 + e cos a) too much, e being its eccentricity over the
track's radius: the exact geometry, not its first harmonic alone.
"""

from typing import NamedTuple

import numpy as np

from emulator.arm import CSP, CST, Power, State
from emulator.current_loop import advance_current
from emulator.kernels import Floats, Ints, compiled


class Sensing(NamedTuple):
    """Constants, shape (J,).

    Attributes:
        offset_A: Reported minus true current.
        delay: Age of reported currents in substeps.
        smoothing: Share of a change that the filter of the reported current lets through in a substep; 1: no filter.
        disc: Amplitude of the angle error on the joint side times `disc_per_rad`: the eccentricity; 0: none.
        disc_per_rad: Periods times 2 pi per joint-side radian, signed.
        disc_phase: [rad].
    """

    offset_A: Floats
    delay: Floats
    smoothing: Floats
    disc: Floats
    disc_per_rad: Floats
    disc_phase: Floats


class Sensed(NamedTuple):
    """State.

    Attributes:
        past: Reported currents of the last substeps, a ring, shape (J, H).
        at: Place of the newest in it, shape (1,).
        smooth: Behind the filter, shape (J,).
    """

    past: Floats
    at: Ints
    smooth: Floats


@compiled
def seen_angle(e: float, per_rad: float, phase: float, angle: float) -> float:
    """Angle that the encoder of a motor at `angle` reads, both on the joint side [rad].

    Args:
        e, per_rad, phase: Eccentricity, periods times 2 pi per radian, phase of the disc.
    """
    if e == 0.0:
        return angle
    turn = per_rad * angle + phase
    return float(angle + np.arctan2(e * np.sin(turn), 1.0 + e * np.cos(turn)) / per_rad)


@compiled
def drive_currents(
    power: Power,
    sensing: Sensing,
    state: State,
    mode: Ints,
    target: Floats,
    target_A: Floats,
    draw: Floats,
    angle: Floats,
    turning: Floats,
    share: float,
    mean: Floats,
) -> None:
    """One substep of all current loops: fills mean, the true currents, shape (J,) [A].

    Args:
        angle, turning: Motor angles and speeds on the joint side.
        share: Of the way from the last position target to this one.
    """
    for j in range(len(mode)):
        mean[j] = 0.0
        if mode[j] not in (CSP, CST):
            continue
        reference = target_A[j]
        if mode[j] == CSP:
            wanted = (state.target[j] + share * (target[j] - state.target[j])) / power.counts_per_rad[j]
            error = wanted - seen_angle(sensing.disc[j], sensing.disc_per_rad[j], sensing.disc_phase[j], angle[j])
            reference = power.stiffness[j] * error - power.damping[j] * turning[j]
        reference = min(max(reference, -power.max_A[j]), power.max_A[j])
        state.current_A[j], state.integrator_V[j], mean[j] = advance_current(
            power.linear[j],
            power.limited[j],
            power.kr[j],
            power.integration[j],
            power.bus_V[j],
            state.current_A[j],
            state.integrator_V[j],
            reference - draw[j] * power.noise_A[j] - sensing.offset_A[j],
            power.emf[j] * turning[j],
        )


@compiled
def report(power: Power, sensing: Sensing, sensed: Sensed, draw: Floats, mean: Floats) -> None:
    """Takes one substep of the current sensors into the ring."""
    ring = sensed.past.shape[1]
    sensed.at[0] = (sensed.at[0] + 1) % ring
    for j in range(len(mean)):
        sample = mean[j] + draw[j] * power.noise_A[j] + sensing.offset_A[j]
        sensed.smooth[j] += sensing.smoothing[j] * (sample - sensed.smooth[j])
        sensed.past[j, sensed.at[0]] = sensed.smooth[j]


@compiled
def reported(past: Floats, newest: int, delay: float) -> float:
    """Current of the last substep, as old as the drive reports it [A].

    Args:
        past: Ring of the axis, `newest` being its latest place.
        delay: Age in substeps; its fraction does not count here.
    """
    return float(past[(newest - int(delay)) % len(past)])


@compiled
def reported_mean(past: Floats, newest: int, delay: float, substeps: int) -> float:
    """Mean current over the last period, as old as the drive reports it [A]; arguments as `reported`."""
    whole = int(delay)
    fraction = delay - whole
    total = 0.0
    for k in range(substeps + 1):
        weight = 1.0 - fraction if k == 0 else (fraction if k == substeps else 1.0)
        total += weight * past[(newest - whole - k) % len(past)]
    return total / substeps
