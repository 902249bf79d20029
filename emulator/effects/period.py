"""One sync period of the arm with everything that effects add, in compiled code.

The leapfrog of `emulator.arm` over more coordinates: base, joints, rotors behind elastic shafts. All springs, bristles
and stops are evaluated in the middle of the substep with h²/4 of their stiffness counted as mass, which makes the
scheme implicit (and energy-keeping) in them and leaves it explicit in everything slow.
"""

from typing import NamedTuple

import numpy as np

from emulator.arm import CSP, CST, Power, State
from emulator.effects.base import Base, Chain
from emulator.effects.drive import Sensed, Sensing, drive_currents, report, reported, reported_mean, seen_angle
from emulator.effects.environment import Environment, Touched, act
from emulator.effects.friction import Rows, Rubbed, bend_on, levels, resist, row_speeds
from emulator.effects.motor import Motors, motor_torques
from emulator.effects.thermal import Thermal, Warm, warm_up
from emulator.effects.transmission import Shafts, transmit
from emulator.effects.unlisted import Unlisted, act_unlisted
from emulator.friction import factor, rub, solve
from emulator.kernels import Floats, Ints, compiled, composite_inertia, newton_euler, place

LOAD_LAG_S = (
    5e-4  # gear losses follow the transmitted torque so late; without it, torque and loss are an algebraic loop
)


class Physics(NamedTuple):
    """Constants.

    Attributes:
        rotor: C' diag(Ia) C of rigid motors, and shared parts, shape (J, J).
        offset_Nm: Of `Parameters`, shape (J,).
        brake_row, brake_Nm: Row of each motor's brake and its torque, shape (J,).
        load_lag: Share by which the transmitted torque is followed in a substep.
    """

    chain: Chain
    base: Base
    rotor: Floats
    offset_Nm: Floats
    brake_row: Ints
    brake_Nm: Floats
    load_lag: float
    rows: Rows
    shafts: Shafts
    motors: Motors
    sensing: Sensing
    environment: Environment
    thermal: Thermal
    unlisted: Unlisted


class Memory(NamedTuple):
    """What changes, in place, beside `emulator.arm.State`, whose q, qd, qdd are views of x, xd, xdd.

    Attributes:
        x, xd, xdd: Base, joints, rotors of elastic axes, shape (n,).
        impulse: Set-valued friction of the last substep, shape (K,).
        load: Torque transmitted to each link, followed with a lag, shape (J,).
        periods: Since power on, shape (1,).
        hidden: Of unlisted physics.
    """

    x: Floats
    xd: Floats
    xdd: Floats
    impulse: Floats
    load: Floats
    periods: Ints
    rubbed: Rubbed
    sensed: Sensed
    touched: Touched
    warm: Warm
    hidden: Floats


@compiled
def _motor_side(C: Floats, of_motor: Ints, rotor: Ints, x: Floats, first: int, out: Floats) -> None:
    """Motor angles or speeds on the joint side, shape (J,): C q, or their own coordinate behind a shaft."""
    for j in range(len(out)):
        if of_motor[j] >= 0:
            out[j] = x[rotor[of_motor[j]]]
            continue
        out[j] = 0.0
        for i in range(len(out)):
            out[j] += C[j, i] * x[first + i]


@compiled
def _switch(physics: Physics, state: State, mode: Ints, target: Floats, h: float, brake: Floats) -> None:
    """What a change of modes does at once; fills the impulse bounds of the brakes, shape (K,)."""
    brake[:] = 0.0
    for j in range(len(mode)):
        if mode[j] not in (CSP, CST):
            brake[physics.brake_row[j]] += h * physics.brake_Nm[j]
            state.current_A[j] = 0.0
            state.integrator_V[j] = 0.0
        if mode[j] != CSP or not state.following[j]:  # nothing to interpolate from
            state.target[j] = target[j]
        state.following[j] = mode[j] == CSP


@compiled
def _follow_load(
    share: float, of_motor: Ints, M: Floats, torque: Floats, xdd: Floats, transmitted: Floats, first: int, load: Floats
) -> None:
    """Torque that each motor's gear transmits: of the shaft, or of rigid links as they moved last."""
    for j in range(len(load)):
        value = transmitted[j]
        if of_motor[j] < 0:
            value = torque[first + j]
            for i in range(len(M)):
                value += M[first + j, i] * xdd[i]
        load[j] += share * (value - load[j])


@compiled
def _add_rigid(
    physics: Physics,
    C: Floats,
    M: Floats,
    torque: Floats,
    drive: Floats,
    middle: Floats,
    xd: Floats,
    h: float,
    kick: Floats,
    A: Floats,
) -> None:
    """Sets torques and mass matrix of links, base, rotors and motors, shape (n,) and (n, n)."""
    N, B, J = len(M), len(physics.base.stiffness), len(drive)
    A[:, :] = 0.0
    kick[:] = 0.0
    for i in range(N):
        kick[i] = -torque[i]
        for k in range(N):
            A[i, k] = M[i, k]
    for i in range(B):
        kick[i] -= physics.base.stiffness[i] * middle[i] + physics.base.damping[i] * xd[i]
        A[i, i] += h * h / 4 * physics.base.stiffness[i] + h / 2 * physics.base.damping[i]
    for j in range(J):
        kick[B + j] -= physics.offset_Nm[j]
        for i in range(J):
            A[B + j, B + i] += physics.rotor[j, i]
            if physics.shafts.of_motor[i] < 0:
                kick[B + j] += C[i, j] * drive[i]
    for e in range(len(physics.shafts.motor)):
        rotor = physics.shafts.rotor[e]
        kick[rotor] += drive[physics.shafts.motor[e]]
        A[rotor, rotor] += physics.shafts.inertia[e]


@compiled
def _rub_rows(
    rows: Rows,
    memory: Memory,
    speed: Floats,
    q: Floats,
    brake: Floats,
    h: float,
    bound: Floats,
    kick: Floats,
    A: Floats,
) -> None:
    """Friction of all rows from the predicted speeds; fills the impulse bounds of what is set-valued."""
    u, start = np.empty(len(bound)), np.empty(len(bound))
    row_speeds(rows.B, speed, u)
    row_speeds(rows.B, memory.xd, start)
    levels(rows, memory.rubbed, u, q, memory.load, memory.warm.lubricant_C)
    bound[:] = brake
    resist(rows, memory.rubbed, u, start, memory.warm.lubricant_C, h, bound, kick, A, memory.warm.loss_W)


@compiled
def _trace(
    sensing: Sensing, sensed: Sensed, counts_per_rad: Floats, angle: Floats, position: Floats, current: Floats
) -> None:
    """What encoders (before rounding and noise) and current sensors read after one substep."""
    for j in range(len(angle)):
        position[j] = seen_angle(sensing.disc[j], sensing.disc_per_rad[j], sensing.disc_phase[j], angle[j])
        position[j] *= counts_per_rad[j]
        current[j] = reported(sensed.past[j], sensed.at[0], sensing.delay[j])


@compiled
def _report(
    physics: Physics, power: Power, state: State, memory: Memory, angle: Floats, draw: Floats, substeps: int
) -> None:
    """Encoders, current sensors and temperatures at the end of a period."""
    sensing, sensed = physics.sensing, memory.sensed
    for j in range(len(angle)):
        seen = seen_angle(sensing.disc[j], sensing.disc_per_rad[j], sensing.disc_phase[j], angle[j])
        state.counts[j] = seen * power.counts_per_rad[j] + draw[j] * power.noise_counts[j]
        state.mean_A[j] = reported_mean(sensed.past[j], sensed.at[0], sensing.delay[j], substeps)
        memory.warm.loss_W[j] /= substeps


@compiled
def advance_with_effects(
    physics: Physics,
    power: Power,
    state: State,
    memory: Memory,
    mode: Ints,
    target: Floats,
    target_A: Floats,
    draws: Floats,
    ambient_C: float,
    h: float,
    trace: Floats,
) -> bool:
    """All substeps of one period; False where the mass matrix is not positive definite.

    Arguments as `emulator.arm.advance_period`.
    """
    substeps, J = len(draws) - 1, len(mode)
    x, xd, xdd = memory.x, memory.xd, memory.xdd
    chain, base, rows, shafts = physics.chain, physics.base, physics.rows, physics.shafts
    N, B, n, K = len(chain.p0), len(base.stiffness), len(x), len(rows.joint)
    R, p, f, m = np.empty((N, 3, 3)), np.empty((N, 3)), np.empty((N, 3)), np.empty((N, 3))
    M, whole, torque, rest = np.empty((N, N)), np.empty((N, 10)), np.empty(N), np.zeros(N)
    A, X, kick, middle, speed = np.empty((n, n)), np.empty((K, n)), np.empty(n), np.empty(n), np.empty(n)
    angle, turning, mean, drive, transmitted = np.empty(J), np.empty(J), np.empty(J), np.empty(J), np.zeros(J)
    end, bound, brake = np.empty(K), np.empty(K), np.empty(K)
    _switch(physics, state, mode, target, h, brake)
    state.temperature_C[:] += power.cooling * (ambient_C - state.temperature_C)
    memory.warm.loss_W[:] = 0.0
    for step in range(substeps):
        for i in range(n):
            middle[i] = x[i] + h / 2 * xd[i]
            speed[i] = xd[i] + h / 2 * xdd[i]
        place(chain.R0, chain.p0, chain.prismatic, middle[:N], R, p)
        newton_euler(R, p, chain.prismatic, chain.gravity, chain.link, speed[:N], rest, torque, f, m)
        composite_inertia(R, p, chain.prismatic, chain.link, M, whole)
        _motor_side(power.C, shafts.of_motor, shafts.rotor, middle, B, angle)
        _motor_side(power.C, shafts.of_motor, shafts.rotor, speed, B, turning)
        share = (step + 0.5) / substeps
        drive_currents(power, physics.sensing, state, mode, target, target_A, draws[step], angle, turning, share, mean)
        motor_torques(physics.motors, power.gain, mean, angle, drive)

        _add_rigid(physics, power.C, M, torque, drive, middle, xd, h, kick, A)
        transmit(shafts, middle, xd, h, kick, A, transmitted)
        t_s = (memory.periods[0] * substeps + step + 0.5) * h
        act(physics.environment, memory.touched, t_s, middle[B:N], speed[B:N], B, h, kick, A)
        act_unlisted(physics.unlisted, memory.hidden, middle[B:N], speed[B:N], B, h, kick)
        _follow_load(physics.load_lag, shafts.of_motor, M, torque, xdd, transmitted, B, memory.load)
        _rub_rows(rows, memory, speed, middle[B:N], brake, h, bound, kick, A)
        if not factor(A):
            return False
        solve(A, kick)
        for i in range(n):
            speed[i] = xd[i] + h * kick[i]
        rub(A, rows.B, bound, speed, memory.impulse, X)
        row_speeds(rows.B, speed, end)
        bend_on(rows, memory.rubbed, end, h)

        report(power, physics.sensing, memory.sensed, draws[step], mean)
        state.temperature_C[:] += power.heating * mean**2 / substeps
        for i in range(n):
            xdd[i] = (speed[i] - xd[i]) / h
            xd[i] = speed[i]
            x[i] = middle[i] + h / 2 * xd[i]
        if len(trace) > 0:
            _motor_side(power.C, shafts.of_motor, shafts.rotor, x, B, angle)
            _trace(physics.sensing, memory.sensed, power.counts_per_rad, angle, trace[step, 0], trace[step, 1])
    state.target[:] = target
    memory.periods[0] += 1
    _motor_side(power.C, shafts.of_motor, shafts.rotor, x, B, angle)
    _report(physics, power, state, memory, angle, draws[substeps], substeps)
    warm_up(physics.thermal, memory.warm, state.temperature_C, ambient_C)
    return True
