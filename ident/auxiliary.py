"""The auxiliary model: the arm under its own control law and reference, simulated from identified parameters.

Janot, Vandanjon & Gautier 2014, III.B. The law is the one that ran: the motion host's sampled PD with its one-cycle
delay and two-tap speed, or the drives' own in position mode. What comes out are signals as the recorder would have seen
them, on the same rows, without noise: the same preparation then gives noise-free columns.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from emulator import simulator
from emulator.simulator import Control, Dynamics, Simulation
from ident.base import Base
from ident.dataset import GAP, Command, Signals
from ident.model import Model
from protocols.errors import ConfigError, DataError, IdentificationError
from protocols.motion import Reference
from protocols.robot import Robot

Array = NDArray[np.float64]

SUBSTEPS = 1  # per row of 1 ms: ten move no position by more than 1e-6 rad
START_S = 0.02  # over which a moving start's speed is fitted
FASTEST = (
    0.55  # of 2 z w T, all axes together: with a cycle of delay, a two-tap speed and a held torque, 0.8 oscillates
)
POSES = 64  # of a motion, at which inertia is looked at
SHARES = (1.0, 0.9, 0.7, 0.4, 0.1)  # of the way to parameters that cannot be simulated
FEWEST = 50  # rows with a reference below which a stretch is not simulated
AT_REST = 0.01  # rad/s at the start below which the arm is taken to stand


@dataclass(frozen=True)
class Stretch:
    """A gapless piece of a recording with its reference.

    Attributes:
        rows: In the signals.
        lead: Rows before the first reference, in which the arm stands.
        reference: From row `lead` on.
        start: Position and speed there, shape (J,) each.
        by_drives: See `ident.dataset.Command`.
    """

    rows: slice
    lead: int
    reference: Reference
    start: tuple[Array, Array]
    by_drives: bool


@dataclass(frozen=True)
class Run:
    """One recording to simulate: its gapless stretches."""

    signals: Signals
    stretches: list[Stretch]


def runs(recordings: Sequence[Signals]) -> list[Run]:
    """What has to be simulated.

    Raises:
        DataError: The reference of a recording is not known.
    """
    return [_run(signals) for signals in recordings]


def standard(base: Base, beta: Array) -> Array:
    """Standard parameters with these base parameters: all others zero, which no body can be and any simulation of base
    parameters may, shape (P,)."""
    theta = np.zeros(base.B.shape[1])
    theta[base.kept] = beta
    return theta


def dynamics(model: Model, theta: Array) -> Dynamics:
    """Simulator's parameters of standard parameters; inverse of how `ident.model` makes the columns."""
    J, C = model.joints, model.coupling
    value = dict(zip(model.names, theta, strict=True))

    def axis(kind: str) -> Array:
        return np.array([value.get(f"{kind}{j + 1}", 0.0) for j in range(J)])

    motor_dry = axis("fc_m")
    rotor = np.diag(axis("Ia"))
    if model.coupled and not model.free_coupling_inertia:
        rotor = C.T @ np.diag(np.linalg.solve((C**2).T, axis("Ia"))) @ C
    return Dynamics(
        link=theta[: 10 * J].reshape(J, 10),
        rotor=rotor + _off_diagonal(C, axis("ia_m")),
        viscous=np.diag(axis("Fv")) + _off_diagonal(C, axis("fv_m")),
        offset_Nm=axis("offset"),
        dry_rows=np.vstack([np.eye(J), C]),
        dry_Nm=np.concatenate([axis("Fc") - np.abs(np.diag(C)) * motor_dry, motor_dry]),
        skew_Nms_rad=np.zeros(2 * J),
    ).merged()


def simulate(
    runs: Sequence[Run], model: Model, theta: Array, *, update_gains: bool, substeps: int = SUBSTEPS
) -> list[list[Simulation]]:
    """Every stretch of every recording at some parameters.

    Args:
        update_gains: Scale the law to the simulated inertia, eq. (22), so that the simulated arm follows the reference
            whatever the parameters; else the law is the recorded one.

    Raises:
        ConfigError: The robot file has no control law.
        IdentificationError: The parameters cannot be simulated; says where and why.
    """
    return [[_simulate(stretch, model, theta, update_gains, substeps) for stretch in run.stretches] for run in runs]


def simulate_near(
    runs: Sequence[Run], model: Model, base: Base, beta: Array, sound: Array, *, update_gains: bool
) -> tuple[list[list[Simulation]], Array]:
    """Every stretch at base parameters, or, where no arm can have them, on the way there from sound ones.

    Noise may leave M without inertia in some direction. The simulated motion hardly depends on that, so the auxiliary
    model is as good with a little of the last sound parameters.

    Returns:
        Simulations, and the parameters they are of, shape (b,).

    Raises:
        IdentificationError: Not even a tenth of the way can be simulated.
    """
    failure: IdentificationError | None = None
    for share in SHARES:
        mixed = sound + share * (beta - sound)
        try:
            return simulate(runs, model, standard(base, mixed), update_gains=update_gains), mixed
        except IdentificationError as error:
            failure = failure or error
    raise failure or IdentificationError("no parameters to simulate")


def as_signals(run: Run, simulations: Sequence[Simulation]) -> Signals:
    """What the recorder would have seen: the mean torque of the period before each row, without noise."""
    q, tau = run.signals.q.copy(), np.zeros_like(run.signals.tau_Nm)
    for stretch, simulation in zip(run.stretches, simulations, strict=True):
        first, end = stretch.rows.start, stretch.rows.stop
        at = first + stretch.lead
        q[first:at] = simulation.q[0]
        q[at:end] = simulation.q
        tau[at + 1 : end] = simulation.tau_Nm[:-1]
    return replace(run.signals, q=q, tau_Nm=tau)


def position_error_percent(runs: Sequence[Run], simulations: Sequence[Sequence[Simulation]]) -> Array:
    """||q - qs|| / ||q|| of every joint over all recordings, shape (J,) (paper, Table 5)."""
    error = square = np.zeros(len(runs[0].signals.joints))
    for run, simulated in zip(runs, simulations, strict=True):
        for stretch, simulation in zip(run.stretches, simulated, strict=True):
            q = run.signals.q[stretch.rows][stretch.lead :]
            error = error + ((q - simulation.q) ** 2).sum(axis=0)
            square = square + (q**2).sum(axis=0)
    return np.asarray(100 * np.sqrt(error / square))


def giving_way(robot: Robot) -> Array:
    """Inertia that each axis seems to have more of under torque commands, motor by motor, shape (J,) [kg·m²].

    A current loop holds its current against the back-EMF only as fast as its integrator: in acceleration the current
    falls behind by s E / (w R), tuned to cancel the winding (w its bandwidth). With E = g dqm that is an inertia of
    g² / (w R). Measured currents contain it, commands do not: 0.04 of TX40's 1.25 kg·m² at axis 1, a third of axis 6.
    """
    drives = [joint.drive for joint in robot.joint]
    return np.array([d.drive_gain_Nm_A**2 / (2 * np.pi * d.current_bandwidth_Hz * d.resistance_Ohm) for d in drives])


def control(model: Model, *, period_s: float, by_drives: bool, inertia_kgm2: Array | None = None) -> Control:
    """The recorded control law; with other inertias, that of the simulated arm, eq. (22).

    Raises:
        ConfigError: An axis has no law.
    """
    robot = model.robot
    known = [joint.control for joint in robot.joint if joint.control is not None]
    for joint in robot.joint:
        if joint.control is None:
            raise ConfigError(
                f"{robot.name}: {joint.name} has no [joint.control]; methods that simulate need the law that ran."
                " Add it to the robot file, or use ols or wls."
            )
    prior = np.array([k.inertia_kgm2 for k in known])
    law = Control.pd(
        [k.natural_frequency_rad_s for k in known],
        [k.damping for k in known],
        prior if inertia_kgm2 is None else inertia_kgm2,
    )
    grown = np.ones(len(prior)) if inertia_kgm2 is None else np.maximum(1.0, inertia_kgm2 / prior)
    if by_drives:  # the drives' law turns with the motors, is fast, and ends at their largest current
        limit = np.array([j.drive.max_current_A * j.drive.drive_gain_Nm_A for j in robot.joint])
        return replace(law, axes=robot.coupling_matrix(), limit_Nm=limit * grown)
    limit = np.array([j.torque_max_Nm for j in robot.joint])
    return replace(law, limit_Nm=limit * grown).sampled(period_s, delay=1, difference=True)


def _off_diagonal(C: Array, motor: Array) -> Array:
    """C' diag(motor) C without the diagonal of each motor's share."""
    return np.asarray(C.T @ np.diag(motor) @ C - np.diag((C**2).T @ motor))


def _simulate(stretch: Stretch, model: Model, theta: Array, update_gains: bool, substeps: int) -> Simulation:
    step = stretch.reference.t_s[1] - stretch.reference.t_s[0]
    law = control(model, period_s=float(step), by_drives=stretch.by_drives)
    if update_gains:
        per_inertia = law.damping / np.array([j.control.inertia_kgm2 for j in model.robot.joint if j.control])
        inertia = simulated_inertia(mass_matrices(model, theta, stretch.reference.q), per_inertia * step)
        law = control(model, period_s=float(step), by_drives=stretch.by_drives, inertia_kgm2=inertia)
    arm, C = dynamics(model, theta), model.coupling
    arm = replace(arm, rotor=arm.rotor + C.T @ np.diag(giving_way(model.robot)) @ C)
    return simulator.simulate(model.geometry, arm, law, stretch.reference, substeps=substeps, start=stretch.start)


def mass_matrices(model: Model, theta: Array, q: Array) -> Array:
    """M at positions spread over a motion of shape (T, J), as torque per unit of acceleration, shape (N, J, J)."""
    poses = q[:: max(1, len(q) // POSES)]
    at_rest = np.zeros_like(poses)
    still = model.regressor(poses, at_rest, at_rest) @ theta
    columns = [model.regressor(poses, at_rest, at_rest + axis) @ theta - still for axis in np.eye(model.joints)]
    return np.ascontiguousarray(np.array(columns).transpose(2, 1, 0))


def simulated_inertia(M: Array, gain: Array) -> Array:
    """Inertia of each axis to scale the law with, eq. (22): the largest M_jj, shape (J,).

    Where axes share much of their inertia, as the wrist of the regular initialisation does (M_56 = M_66), loops scaled
    by M_jj are faster together than each alone, too fast for a law with a cycle of delay. The inertia that an axis
    feels while the others are free, 1/inv(M)_jj, bounds that; as little as needed of it is mixed in.

    Args:
        M: Mass matrices along the motion, shape (N, J, J).
        gain: Share of an axis' speed that the law takes away within a period, 2 z w T, shape (J,).
    """
    largest = np.asarray(M.diagonal(axis1=1, axis2=2).max(axis=0))
    if not (np.linalg.eigvalsh(M) > 0).all():
        return largest
    inverse = np.linalg.inv(M)
    free = (1 / inverse.diagonal(axis1=1, axis2=2)).max(axis=0)

    def excess(share: float) -> float:
        loop = inverse * (gain * (largest + share * (free - largest)))
        return float(np.abs(np.linalg.eigvals(loop)).max()) - FASTEST

    if excess(0.0) <= 0:
        return largest
    share = 1.0 if excess(1.0) >= 0 else float(optimize.brentq(excess, 0.0, 1.0, xtol=1e-3))
    return np.asarray(largest + share * (free - largest))


def _run(signals: Signals) -> Run:
    if signals.command is None:
        raise DataError(
            f"{signals.source}: the reference trajectory is not known, and methods that simulate need it. Record with"
            " armrig record while the host streams its targets, or use ols or wls."
        )
    command = signals.command()
    period = float(np.median(np.diff(signals.t_s)))
    breaks = np.flatnonzero(np.diff(signals.t_s) > GAP * period) + 1
    bounds = [0, *(int(b) for b in breaks), len(signals.t_s)]
    found = [_stretch(signals, command, slice(a, b), period) for a, b in itertools.pairwise(bounds)]
    stretches = [stretch for stretch in found if stretch is not None]
    if not stretches:
        raise DataError(
            f"{signals.source}: no gapless stretch of it has a reference trajectory. Let the recorder run while the"
            " host streams its targets."
        )
    return Run(signals, stretches)


def _stretch(signals: Signals, command: Command, rows: slice, period: float) -> Stretch | None:
    """None where the host did not command anything."""
    reference, q = command.reference[rows], signals.q[rows]
    known = np.asarray(np.isfinite(reference).all(axis=1))
    if known.sum() < FEWEST or not known[int(np.argmax(known)) :].all():
        return None
    lead = int(np.argmax(known))
    reference = reference[lead:]
    if command.by_drives:  # a drive reaches its target at the end of the period
        reference = np.vstack([reference[:1], reference[:-1]])
    begin = max(2, round(START_S / period))
    line = np.polynomial.polynomial.polyfit(period * np.arange(begin), q[lead : lead + begin], 2)
    start_q, start_qd = np.asarray(line[0]), np.asarray(line[1])
    if lead > 0 or (np.abs(start_qd) < AT_REST).all():
        start_q, start_qd = np.median(q[: lead + 1], axis=0), np.zeros_like(start_qd)
    return Stretch(rows, lead, simulator.reference_of(reference, period), (start_q, start_qd), command.by_drives)
