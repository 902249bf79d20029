"""One sync period of the simulated arm with its power stages, in compiled code.

M(q) qdd + N(q, qd) + friction = C' G i - offset, with M holding the rotors C' diag(Ia) C, motor speeds C qd, viscous
and exact Coulomb friction on joints and motors, brakes on the motors. One substep drifts half a step, kicks with the
forces at the middle and drifts again (leapfrog): second order, no fictitious damping. Viscous friction is taken by
the trapezoidal rule and dry friction at the end of the step, so no friction is too steep for the step.
"""

from typing import NamedTuple

import numpy as np

from emulator.current_loop import advance_current
from emulator.friction import factor, rub, solve
from emulator.kernels import Floats, Ints, compiled, composite_inertia, newton_euler, place

CSP, CST = 8, 10  # modes of operation 0x6060 (CiA 402); any other is power off with the brake engaged


class Body(NamedTuple):
    """Constants of the mechanics, arrays as in `protocols.robot.Geometry` and `emulator.kernels`.

    Attributes:
        rotor: C' diag(Ia) C, shape (J, J) [kg·m²].
        viscous: diag(Fv) + C' diag(Fvm) C, shape (J, J) [N·m·s/rad].
        dry_rows: Speeds with dry friction, shape (K, J).
        dry_Nm: Coulomb friction of each row, shape (K,).
        brake_row: Row on which the brake of each motor acts, shape (J,).
        brake_Nm: Holding torque, joint side, shape (J,).
    """

    R0: Floats
    p0: Floats
    prismatic: Ints
    gravity: Floats
    link: Floats
    rotor: Floats
    viscous: Floats
    offset_Nm: Floats
    dry_rows: Floats
    dry_Nm: Floats
    brake_row: Ints
    brake_Nm: Floats


class Power(NamedTuple):
    """Constants of drives, encoders and windings, one entry or row per axis.

    Attributes:
        C: Motor speed (joint side) = C qd.
        gain: Torque per ampere on the joint side, with the sign of the gear [N·m/A].
        emf: Back-EMF per speed of the motor on the joint side, signed [V·s/rad].
        stiffness, damping: CSP law, current per position and speed error, signed [A/rad], [A·s/rad].
        linear, limited, kr, integration: Of `current_loop.advance_current`.
        noise_A: Standard deviation of the current sensor over one substep.
        counts_per_rad: Signed, motor angle on the joint side.
        noise_counts: Standard deviation of an encoder reading.
        heating: Rise of the winding's temperature over one period per mean square current [K/A²].
        cooling: Share of its rise above ambient that a winding loses in one period.
    """

    C: Floats
    gain: Floats
    emf: Floats
    max_A: Floats
    bus_V: Floats
    stiffness: Floats
    damping: Floats
    linear: Floats
    limited: Floats
    kr: Floats
    integration: Floats
    noise_A: Floats
    counts_per_rad: Floats
    noise_counts: Floats
    heating: Floats
    cooling: float


class State(NamedTuple):
    """What changes, in place.

    Attributes:
        q, qd, qdd: Joints; qdd is the mean over the last substep, which predicts the next.
        impulse: Dry friction of the last substep, shape (K,) [N·m·s].
        current_A, integrator_V: Current loops.
        target: Position target at the end of the last period [counts].
        following: 1 where the last period was in CSP.
        mean_A: Current over the last period as the sensor reports it.
        counts: Encoders as read at the end of the last period, before rounding.
        temperature_C: Windings.
    """

    q: Floats
    qd: Floats
    qdd: Floats
    impulse: Floats
    current_A: Floats
    integrator_V: Floats
    target: Floats
    following: Ints
    mean_A: Floats
    counts: Floats
    temperature_C: Floats


@compiled
def _currents(
    power: Power,
    state: State,
    mode: Ints,
    target: Floats,
    target_A: Floats,
    draw: Floats,
    middle: Floats,
    speed: Floats,
    share: float,
    mean: Floats,
) -> None:
    """One substep of all current loops: fills mean, shape (J,) [A].

    Args:
        middle, speed: Joint positions and speeds in the middle of the substep.
        share: Of the way from the last position target to this one.
    """
    J = len(mode)
    for j in range(J):
        mean[j] = 0.0
        if mode[j] not in (CSP, CST):
            continue
        angle, turning = 0.0, 0.0
        for i in range(J):
            angle += power.C[j, i] * middle[i]
            turning += power.C[j, i] * speed[i]
        reference = target_A[j]
        if mode[j] == CSP:
            wanted = (state.target[j] + share * (target[j] - state.target[j])) / power.counts_per_rad[j]
            reference = power.stiffness[j] * (wanted - angle) - power.damping[j] * turning
        reference = min(max(reference, -power.max_A[j]), power.max_A[j])
        state.current_A[j], state.integrator_V[j], mean[j] = advance_current(
            power.linear[j],
            power.limited[j],
            power.kr[j],
            power.integration[j],
            power.bus_V[j],
            state.current_A[j],
            state.integrator_V[j],
            reference - draw[j] * power.noise_A[j],
            power.emf[j] * turning,
        )


@compiled
def _switch(body: Body, state: State, mode: Ints, target: Floats, h: float) -> Floats:
    """What a change of modes does at once; returns the largest dry friction impulses, shape (K,) [N·m·s]."""
    bound = h * body.dry_Nm
    for j in range(len(mode)):
        if mode[j] not in (CSP, CST):
            bound[body.brake_row[j]] += h * body.brake_Nm[j]
            state.current_A[j] = 0.0
            state.integrator_V[j] = 0.0
        if mode[j] != CSP or not state.following[j]:  # nothing to interpolate from
            state.target[j] = target[j]
        state.following[j] = mode[j] == CSP
        state.mean_A[j] = 0.0
    return bound


@compiled
def _sense(power: Power, state: State, draw: Floats) -> None:
    """Encoders at the end of a period."""
    J = len(draw)
    for j in range(J):
        angle = 0.0
        for i in range(J):
            angle += power.C[j, i] * state.q[i]
        state.counts[j] = angle * power.counts_per_rad[j] + draw[j] * power.noise_counts[j]


@compiled
def _trace(power: Power, state: State, draw: Floats, mean: Floats, position: Floats, current: Floats) -> None:
    """What encoders (before rounding and noise) and current sensors read after one substep."""
    J = len(mean)
    for j in range(J):
        angle = 0.0
        for i in range(J):
            angle += power.C[j, i] * state.q[i]
        position[j] = angle * power.counts_per_rad[j]
        current[j] = mean[j] + draw[j] * power.noise_A[j]


@compiled
def advance_period(
    body: Body,
    power: Power,
    state: State,
    mode: Ints,
    target: Floats,
    target_A: Floats,
    draws: Floats,
    ambient_C: float,
    h: float,
    trace: Floats,
) -> bool:
    """All substeps of one period; False where the mass matrix is not positive definite.

    Args:
        target: Motor positions [counts].
        draws: Standard normal, one row per substep for the current sensors and one for the encoders.
        h: Substep [s].
        trace: Filled with encoders [counts] and currents [A] after each substep, shape (substeps, 2, J); of length 0
            where nobody wants to know.
    """
    substeps, J = len(draws) - 1, len(mode)
    K = len(body.dry_Nm)
    R, p, f, n = np.empty((J, 3, 3)), np.empty((J, 3)), np.empty((J, 3)), np.empty((J, 3))
    M, whole, X = np.empty((J, J)), np.empty((J, 10)), np.empty((K, J))
    middle, speed, rest = np.empty(J), np.empty(J), np.zeros(J)
    torque, kick, mean = np.empty(J), np.empty(J), np.empty(J)
    q, qd, qdd = state.q, state.qd, state.qdd
    bound = _switch(body, state, mode, target, h)
    for j in range(J):
        state.temperature_C[j] += power.cooling * (ambient_C - state.temperature_C[j])
    for step in range(substeps):
        middle[:] = q + h / 2 * qd
        speed[:] = qd + h / 2 * qdd
        place(body.R0, body.p0, body.prismatic, middle, R, p)
        newton_euler(R, p, body.prismatic, body.gravity, body.link, speed, rest, torque, f, n)
        composite_inertia(R, p, body.prismatic, body.link, M, whole)
        _currents(power, state, mode, target, target_A, draws[step], middle, speed, (step + 0.5) / substeps, mean)

        for j in range(J):
            kick[j] = -torque[j] - body.offset_Nm[j]
            for i in range(J):
                kick[j] += power.C[i, j] * power.gain[i] * mean[i] - body.viscous[j, i] * qd[i]
                M[j, i] += body.rotor[j, i] + h / 2 * body.viscous[j, i]
        if not factor(M):
            return False
        solve(M, kick)
        speed[:] = qd + h * kick
        rub(M, body.dry_rows, bound, speed, state.impulse, X)

        for j in range(J):
            state.mean_A[j] += (mean[j] + draws[step, j] * power.noise_A[j]) / substeps
            state.temperature_C[j] += power.heating[j] * mean[j] ** 2 / substeps
            qdd[j] = (speed[j] - qd[j]) / h
            qd[j] = speed[j]
            q[j] = middle[j] + h / 2 * qd[j]
        if len(trace) > 0:
            _trace(power, state, draws[step], mean, trace[step, 0], trace[step, 1])
    state.target[:] = target
    _sense(power, state, draws[substeps])
    return True
