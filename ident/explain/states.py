"""Hidden states driven by the measured motion: pre-sliding, the far side of an elastic gear, heat."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

FINEST_RAD = 0.12  # phase of the stiffest resonance per integration step


def dahl(step: Array, reach: Array, *, circular: bool) -> Array:
    """Pre-sliding displacement over its range, z / z_r in (-1, 1), for several ranges (Dahl 1968, exact per step).

    Args:
        step: Displacement in each sample, shape (T,).
        reach: z_r, shape (G,).

    Returns:
        shape (G, T).
    """
    return np.asarray(_dahl(np.ascontiguousarray(step), np.ascontiguousarray(reach), 2 if circular else 1))


def elastic_torque(
    motor: Array,
    inertia: Array,
    other: Array,
    dt: float,
    stiffness: Array,
    damping: Array,
    gap: Array,
    *,
    circular: bool,
) -> Array:
    """Torque through a transmission whose far side swings: J qL'' + other = tau, tau = K dz(theta - qL, gap) + D (...).

    Args:
        motor: Position of the near side, shape (T,).
        inertia: J of the far side, shape (T,).
        other: All of its torque but J times acceleration, shape (T,).
        stiffness, damping, gap: K, D and full width of the dead zone, shape (G,).

    Returns:
        shape (G, T).
    """
    omega = np.sqrt(stiffness / inertia.min())
    substeps = np.maximum(1, np.ceil(omega * dt / FINEST_RAD)).astype(np.int64)
    near, mass, load = (np.ascontiguousarray(a) for a in (motor, inertia, other))
    return np.asarray(_elastic(near, mass, load, dt, stiffness, damping, gap, substeps, 2 if circular else 1))


def lag(source: Array, dt: float, time_s: float, start: float) -> Array:
    """First-order lag of a signal of shape (T,): T x' = u - x."""
    return np.asarray(_lag(np.ascontiguousarray(source), dt / time_s, start))


@njit(cache=True)
def _dahl(step: Array, reach: Array, passes: int) -> Array:
    out = np.zeros((len(reach), len(step)))
    for g in range(len(reach)):
        z = 0.0
        for _ in range(passes):
            for t in range(len(step)):
                x = step[t] / reach[g]
                s = 1.0 if x > 0.0 else -1.0
                z = s * (1.0 - (1.0 - s * z) * np.exp(-abs(x)))
                out[g, t] = z
    return out


@njit(cache=True)
def _elastic(
    motor: Array,
    inertia: Array,
    other: Array,
    dt: float,
    stiffness: Array,
    damping: Array,
    gap: Array,
    substeps: NDArray[np.int64],
    passes: int,
) -> Array:
    T, G = len(motor), len(stiffness)
    out = np.empty((G, T))
    for g in range(G):
        K, D, half = stiffness[g], damping[g], 0.5 * gap[g]
        n = substeps[g]
        h = dt / n
        e = other[0] / K
        e += half if e > 0.0 else -half
        q, v = motor[0] - e, (motor[1] - motor[0]) / dt
        for _ in range(passes):
            shift = motor[0] - motor[T - 1] if passes > 1 else 0.0
            for t in range(T):
                ahead = t + 1 if t + 1 < T else t
                speed = (motor[ahead] - motor[t]) / dt
                torque = 0.0
                for i in range(n):
                    x = (i + 0.5) / n
                    J = inertia[t] + x * (inertia[ahead] - inertia[t])
                    load = other[t] + x * (other[ahead] - other[t])
                    e = motor[t] + x * (motor[ahead] - motor[t]) - q
                    torque = 0.0
                    if e > half:
                        torque = K * (e - half)
                    elif e < -half:
                        torque = K * (e + half)
                    touching = 1.0 if abs(e) > half else 0.02
                    # damping implicit: stiff where the far side is light
                    v = (v + h / J * (torque - load + touching * D * speed)) / (1.0 + h / J * touching * D)
                    torque += touching * D * (speed - v)
                    q += h * v
                    if i == 0:
                        out[g, t] = torque
            q += shift
    return out


@njit(cache=True)
def _lag(source: Array, share: float, start: float) -> Array:
    out = np.empty(len(source))
    x = start
    keep = np.exp(-share)
    for t in range(len(source)):
        out[t] = x
        x = source[t] + (x - source[t]) * keep
    return out
