"""PI current loop of one axis, exact between samples.

Winding L di/dt = u - R i - e with back-EMF e; controller u = KR (error + integral of error / TN), the parameters
KR [V/A] and TN [s] that drive manuals name. As long as the bus voltage suffices this is a linear system, so one
substep with constant reference, sensor noise and back-EMF is one matrix product and no error of discretisation.
"""

import numpy as np
from scipy.linalg import expm

from emulator.kernels import Floats, compiled
from protocols.robot import Drive


def closed_loop(drive: Drive, kr: float, tn_s: float, h_s: float) -> Floats:
    """One substep of the loop within its voltage limit.

    Returns:
        Rows: current and integrator voltage at the end, mean current; columns: current and integrator voltage at
        the start, reference minus sensor noise, back-EMF; shape (3, 4).
    """
    R, L = drive.resistance_Ohm, drive.inductance_H
    A = np.zeros((5, 5))  # states: current, integrator, reference, back-EMF (constant), integral of the current
    A[0, :4] = -(R + kr) / L, 1 / L, kr / L, -1 / L
    A[1, :4] = -kr / tn_s, 0.0, kr / tn_s, 0.0
    A[4, 0] = 1 / h_s
    return np.ascontiguousarray(expm(A * h_s)[[0, 1, 4], :4])


def saturated(drive: Drive, h_s: float) -> Floats:
    """One substep at constant voltage: rows current at the end, mean current; columns current, u - e; shape (2, 2)."""
    R, L = drive.resistance_Ohm, drive.inductance_H
    decay = np.exp(-h_s * R / L)
    mean = (1 - decay) * L / (R * h_s)
    return np.array([[decay, (1 - decay) / R], [mean, (1 - mean) / R]])


@compiled
def advance_current(
    linear: Floats,
    limited: Floats,
    kr: float,
    integration: float,
    bus_V: float,
    current: float,
    integrator: float,
    error_input: float,
    emf: float,
) -> tuple[float, float, float]:
    """One substep: current [A] and integrator [V] at the end, mean current [A].

    Args:
        linear, limited: Of `closed_loop` and `saturated`.
        integration: KR h / TN [V/A], the integrator's gain over the substep.
        error_input: Reference minus sensor noise [A].
        emf: Back-EMF [V].
    """
    error = error_input - current
    u = kr * error + integrator
    if -bus_V <= u <= bus_V:
        return (
            linear[0, 0] * current + linear[0, 1] * integrator + linear[0, 2] * error_input + linear[0, 3] * emf,
            linear[1, 0] * current + linear[1, 1] * integrator + linear[1, 2] * error_input + linear[1, 3] * emf,
            linear[2, 0] * current + linear[2, 1] * integrator + linear[2, 2] * error_input + linear[2, 3] * emf,
        )
    clipped = bus_V if u > 0.0 else -bus_V
    if error * clipped < 0.0:  # anti-windup: the integrator moves only away from the limit
        integrator += integration * error
    drive = clipped - emf
    return (
        limited[0, 0] * current + limited[0, 1] * drive,
        integrator,
        limited[1, 0] * current + limited[1, 1] * drive,
    )
