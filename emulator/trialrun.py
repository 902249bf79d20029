"""One recording by the short way: host, drives and arm in one compiled loop, without frames and start-up.

What the bus would do to the numbers is here: targets and currents in per mille, positions in counts, the law of the
host one cycle late. Ten times as fast as the way over the bus, for choosing and for development.
"""

from dataclasses import dataclass

import numpy as np

from emulator.arm import CST, Power, State
from emulator.effects.period import Memory, Physics, advance_with_effects
from emulator.kernels import Floats, Ints, compiled
from emulator.plant import Plant
from protocols.errors import ConfigError
from protocols.motion import Motion, sample
from protocols.rig import Rig
from protocols.robot import Robot

_BLOCK = 1000  # periods whose noise is drawn at once


@dataclass(frozen=True)
class Signals:
    """What a recording would hold.

    Attributes:
        t_s: shape (T,).
        position_counts, current_permille: shape (T, J).
        reference: Of the host, shape (T, J) [rad].
        temperature_C: Of the motors, as the cell shows them, shape (T, J).
    """

    t_s: Floats
    position_counts: Ints
    current_permille: Ints
    reference: Floats
    temperature_C: Floats


@compiled
def _stream(
    physics: Physics,
    power: Power,
    state: State,
    memory: Memory,
    reference: Floats,
    to_joint: Floats,
    stiffness: Floats,
    damping: Floats,
    limit: Floats,
    to_permille: Floats,
    target: Floats,
    last: Floats,
    draws: Floats,
    ambient_C: float,
    h: float,
    counts: Floats,
    permille: Floats,
    celsius: Floats,
) -> int:
    """PD law of Janot et al. 2014, eq. (19), as `emulator.host.PdLaw` streams it; returns the periods done.

    Args:
        stiffness, damping: On position error, and on a difference of positions, shape (J,) [N·m/rad].
        to_permille: Drive currents of joint torques, as matrix, and per mille of each drive, shape (J + 1, J).
        target, last: Targets [A] and positions [rad] of the period before, shape (J,); overwritten.
        counts, permille, celsius: Filled, shape (T, J).
    """
    T, J = reference.shape
    mode, unused, quiet = np.full(J, CST), np.zeros(J), np.empty((0, 2, J))
    torque = np.empty(J)
    for n in range(T):
        if not advance_with_effects(physics, power, state, memory, mode, unused, target, draws[n], ambient_C, h, quiet):
            return n
        for j in range(J):
            counts[n, j] = np.rint(state.counts[j])
            permille[n, j] = np.rint(state.mean_A[j] * to_permille[J, j])
            celsius[n, j] = memory.warm.shown_C[j]
        for j in range(J):
            q = 0.0
            for i in range(J):
                q += counts[n, i] * to_joint[i, j]
            value = stiffness[j] * (reference[n, j] - q) - damping[j] * (q - last[j])
            torque[j] = min(max(value, -limit[j]), limit[j])
            last[j] = q
        for j in range(J):
            value = 0.0
            for i in range(J):
                value += torque[i] * to_permille[i, j]
            target[j] = np.rint(value * to_permille[J, j]) / to_permille[J, j]
    return len(reference)


def run(rig: Rig, robot: Robot, machine: Robot, plan: Motion, temperature_C: float, seed: int) -> Signals:
    """A motion from where the machine stands.

    Args:
        robot: As the host believes it to be.
        temperature_C: Of motors and lubricants at the start.

    Raises:
        ConfigError: As `Plant`, or the machine ran away.
    """
    J, period_s = robot.joints, rig.sync_period_us * 1e-6
    rng = np.random.default_rng(seed)
    plant = Plant(
        machine,
        period_s,
        rng,
        np.array(rig.emulated.current_noise_A),
        np.array(rig.emulated.encoder_noise_rad),
        extended=True,
    )
    plant.warm_to(np.full(J, temperature_C))
    laws = [joint.control for joint in robot.joint]
    arrays = plant.compiled()
    if arrays is None or None in laws:
        raise ConfigError(f"{robot.name}: every joint needs [joint.control], or no host can move it.")
    law = [(c.natural_frequency_rad_s, c.damping, c.inertia_kgm2) for c in laws if c is not None]
    w, z, inertia = np.array(law).T
    to_joint = robot.joint_position(np.eye(J))
    to_permille = np.vstack(
        [robot.drive_current(np.eye(J)), [1000 / joint.drive.rated_current_A for joint in robot.joint]]
    )
    limit = np.array([joint.torque_max_Nm for joint in robot.joint])
    last = plant.measure()[0] @ to_joint
    reference = sample(plan, robot, period_s, last).q
    T, target = len(reference), np.zeros(J)
    counts, permille, celsius = np.empty((T, J)), np.empty((T, J)), np.empty((T, J))
    substeps = round(period_s / plant.substep_s)
    for begin in range(0, T, _BLOCK):
        rows = slice(begin, min(begin + _BLOCK, T))
        size = rows.stop - begin
        done = _stream(
            *arrays,
            reference[rows],
            to_joint,
            w**2 * inertia,
            2 * z * w * inertia / period_s,
            limit,
            to_permille,
            target,
            last,
            rng.standard_normal((size, substeps + 1, J)),
            plant.ambient_C,
            plant.substep_s,
            counts[rows],
            permille[rows],
            celsius[rows],
        )
        if done < size:
            raise ConfigError(
                f"{machine.name}: the mass matrix is not positive definite {(begin + done) * period_s:.3f} s after the"
                " start. Use parameters that a physical arm can have."
            )
    t_s = period_s * np.arange(1, T + 1, dtype=float)
    return Signals(t_s, counts.astype(np.int64), permille.astype(np.int64), reference, celsius)
