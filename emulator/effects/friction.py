"""Friction of each row of speeds: how large it is (level) and how it acts (contact law).

The level of one direction is Coulomb friction with Stribeck's excess, asymmetry, load, gear losses, worn spots and
temperature. It acts either as exact set-valued friction (`emulator.friction.rub`) or, in presliding, through
generalised Maxwell slip: elastic bristles in parallel, each sliding at its share of the level (Al-Bender, Lampaert &
Swevers 2005), which gives hysteresis with nonlocal memory and dissipates on every closed path.

Stribeck's excess falls as exp(-(w/vs)^p), Tustin's form for p = 1, with w the speed through a first-order lag:
the frictional memory of Armstrong-Hélouvry, Dupont & Canudas de Wit 1994, sec. 2.1.4. Nonlinear viscous friction
is Carreau's law of shear-dependent viscosity (Carreau 1972): linear at creep, a power of speed well above it. Gear
losses by direction of power: Dohring, Lee & Newman 1993.
"""

from typing import NamedTuple

import numpy as np

from emulator.kernels import Floats, Ints, compiled

KNEE = 4.0  # Carreau's (lambda v)² at the reference speed: the power law holds from half of that speed on
# Bristles slide at these displacements, in units of the presliding distance; their limits follow the hull of
# 1 - exp(-x), normalised.
SLIDE_AT = np.array([0.15, 0.4, 0.8, 1.4, 2.4, 4.0])


def bristles() -> tuple[Floats, Floats]:
    """Limits (shares of the level, sum 1) and displacements at sliding of all bristles, shape (M,) each."""
    hull = 1 - np.exp(-SLIDE_AT)
    slope = np.diff(np.r_[0.0, hull / hull[-1]]) / np.diff(np.r_[0.0, SLIDE_AT])
    stiffness = slope - np.r_[slope[1:], 0.0]
    return stiffness * SLIDE_AT, SLIDE_AT


class Rows(NamedTuple):
    """Constants, one entry per row; a value of 0 switches its effect off.

    Attributes:
        B: Row speed = B times the speeds of all coordinates, shape (K, n).
        joint: Whose position, load and temperature count.
        coulomb, viscous: [N·m], [N·m·s/rad].
        stiction, stribeck, exponent, lag: Excess, speed, exponent, share by which the lag closes in a substep.
        asymmetry: Half difference of the directions.
        curve, curve_speed, curve_power: Nonlinear viscous torque at its speed, and power.
        load, preload, driving, braking: Friction per transmitted torque, always; driving; braking.
        distance, bristle_damping: Presliding.
        limit, slide_at: Of `bristles`, shape (M,).
        viscous_per_K, coulomb_per_K, reference_C: Temperature.
        spot_row, spot, spot_centre, spot_width: Worn spots, shape (P,).
    """

    B: Floats
    joint: Ints
    coulomb: Floats
    viscous: Floats
    stiction: Floats
    stribeck: Floats
    exponent: Floats
    lag: Floats
    asymmetry: Floats
    curve: Floats
    curve_speed: Floats
    curve_power: Floats
    load: Floats
    preload: Floats
    driving: Floats
    braking: Floats
    distance: Floats
    bristle_damping: Floats
    limit: Floats
    slide_at: Floats
    viscous_per_K: Floats
    coulomb_per_K: Floats
    reference_C: Floats
    spot_row: Ints
    spot: Floats
    spot_centre: Floats
    spot_width: Floats


class Rubbed(NamedTuple):
    """State of the rows.

    Attributes:
        bristle: Deflections, shape (K, M).
        recent: Lagged speed, shape (K,).
        forward, backward: Levels of the two directions, shape (K,) [N·m].
    """

    bristle: Floats
    recent: Floats
    forward: Floats
    backward: Floats


@compiled
def row_speeds(B: Floats, speed: Floats, out: Floats) -> None:
    """Fills out, shape (K,)."""
    for k in range(len(out)):
        out[k] = 0.0
        for i in range(len(speed)):
            if B[k, i] != 0.0:
                out[k] += B[k, i] * speed[i]


@compiled
def levels(rows: Rows, state: Rubbed, u: Floats, q: Floats, load: Floats, celsius: Floats) -> None:
    """Fills the levels of both directions.

    Args:
        u: Row speeds, shape (K,).
        q, load, celsius: Position, transmitted torque and lubricant temperature of each joint, shape (J,).
    """
    for k in range(len(u)):
        j = rows.joint[k]
        state.recent[k] += rows.lag[k] * (abs(u[k]) - state.recent[k])
        dry = rows.coulomb[k]
        if rows.stiction[k] != 0.0:
            dry += rows.stiction[k] * np.exp(-((state.recent[k] / rows.stribeck[k]) ** rows.exponent[k]))
        if rows.coulomb_per_K[k] != 0.0:
            dry *= np.exp(rows.coulomb_per_K[k] * (celsius[j] - rows.reference_C[k]))
        torque = load[j]
        if rows.load[k] != 0.0:
            dry += rows.load[k] * (np.sqrt(torque * torque + rows.preload[k] ** 2) - rows.preload[k])
        forward, backward = dry + rows.asymmetry[k], dry - rows.asymmetry[k]
        if torque > 0.0:
            forward += rows.driving[k] * torque
            backward += rows.braking[k] * torque
        else:
            forward -= rows.braking[k] * torque
            backward -= rows.driving[k] * torque
        state.forward[k], state.backward[k] = forward, backward
    for p in range(len(rows.spot)):
        k = rows.spot_row[p]
        x = (q[rows.joint[k]] - rows.spot_centre[p]) / rows.spot_width[p]
        worn = rows.spot[p] / (1.0 + x**4)
        state.forward[k] += worn
        state.backward[k] += worn
    for k in range(len(u)):
        state.forward[k] = max(state.forward[k], 0.0)
        state.backward[k] = max(state.backward[k], 0.0)


@compiled
def shear(u: float, torque: float, at: float, power: float) -> float:
    """Nonlinear viscous friction per speed, Carreau's law through `torque` at speed `at` [N·m·s/rad]."""
    x = u / at
    return float(torque / at * ((1.0 + KNEE * x * x) / (1.0 + KNEE)) ** ((power - 1.0) / 2))


@compiled
def bend(
    bristle: Floats,
    limit: Floats,
    slide_at: Floats,
    distance: float,
    reference: float,
    forward: float,
    backward: float,
    travel: float,
) -> tuple[float, float]:
    """Moves the bristles of one row; returns their torque [N·m] and the stiffness of those that do not slide.

    Args:
        bristle: Their deflections, shape (M,).
        reference: Level at which they have the presliding distance.
    """
    up, down = forward / reference, backward / reference
    torque, sticking = 0.0, 0.0
    for i in range(len(limit)):
        length = slide_at[i] * distance
        stiffness = limit[i] * reference / length
        z = bristle[i] + travel
        if z > length * up:
            z = length * up
        elif z < -length * down:
            z = -length * down
        else:
            sticking += stiffness
        bristle[i] = z
        torque += stiffness * z
    return torque, sticking


@compiled
def add_outer(A: Floats, row: Floats, weight: float) -> None:
    """A += weight row row', for rows that are mostly 0."""
    for i in range(len(row)):
        if row[i] != 0.0:
            for j in range(len(row)):
                A[i, j] += weight * row[i] * row[j]


@compiled
def resist(
    rows: Rows,
    state: Rubbed,
    u: Floats,
    start: Floats,
    celsius: Floats,
    h: float,
    bound: Floats,
    kick: Floats,
    A: Floats,
    loss_W: Floats,
) -> None:
    """Adds friction of all rows to torques and mass matrix, and set-valued friction to the impulse bounds.

    Viscous friction by the trapezoidal rule. Bristles are springs: they drift half a step before the kick and half a
    step after it, and h²/4 of their stiffness counts as mass, which keeps the leapfrog stable at any stiffness.

    Args:
        u, start: Row speeds in the middle (predicted) and at the start of the substep, shape (K,).
        loss_W: Friction power of each joint, shape (J,); added to.
    """
    for k in range(len(u)):
        j = rows.joint[k]
        forward, backward = state.forward[k], state.backward[k]
        damping = rows.viscous[k]
        if rows.viscous_per_K[k] != 0.0:
            damping *= np.exp(rows.viscous_per_K[k] * (celsius[j] - rows.reference_C[k]))
        if rows.curve[k] != 0.0:
            damping += shear(u[k], rows.curve[k], rows.curve_speed[k], rows.curve_power[k])
        loss_W[j] += damping * u[k] ** 2 + (forward * u[k] if u[k] > 0.0 else -backward * u[k])
        torque, weight = (forward - backward) / 2, 0.0
        if rows.distance[k] > 0.0:
            torque, sticking = bend(
                state.bristle[k],
                rows.limit,
                rows.slide_at,
                rows.distance[k],
                rows.coulomb[k] + rows.stiction[k],
                forward,
                backward,
                h / 2 * start[k],
            )
            weight = h * h / 4 * sticking
            if sticking > 0.0:
                damping += rows.bristle_damping[k]
        else:
            bound[k] += h * (forward + backward) / 2
        weight += h / 2 * damping
        torque += damping * start[k]
        for i in range(len(kick)):
            if rows.B[k, i] != 0.0:
                kick[i] -= rows.B[k, i] * torque
        if weight != 0.0:
            add_outer(A, rows.B[k], weight)


@compiled
def bend_on(rows: Rows, state: Rubbed, end: Floats, h: float) -> None:
    """Second half of the bristles' drift, at the speeds after the kick."""
    for k in range(len(end)):
        if rows.distance[k] > 0.0:
            bend(
                state.bristle[k],
                rows.limit,
                rows.slide_at,
                rows.distance[k],
                rows.coulomb[k] + rows.stiction[k],
                state.forward[k],
                state.backward[k],
                h / 2 * end[k],
            )
