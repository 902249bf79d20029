"""Does the explained model move like the machine? The closed loop, simulated with and without the effects.

The simulator of the arm knows rigid bodies, rotors and friction. An effect is given to it as the torque that it has
along the measured motion: that torque, taken from the reference through the control law's stiffness, is the same
disturbance (Janot et al. 2014, eq. (19): the law is linear). First order in the difference between simulated and
measured motion, which is what is to become small.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator import simulator
from ident import auxiliary
from ident.explain.judge import Model3
from ident.explain.motion import Run
from ident.explain.scene import View
from protocols.errors import ArmrigError

Array = NDArray[np.float64]

LEAD = 1.5  # periods by which a sampled law's torque is older than its reference
SETTLE_S = 0.5  # after the start, in which the unknown initial speed matters


@dataclass(frozen=True)
class Closed:
    """Closed-loop mismatch before and after.

    Attributes:
        position: Root mean square of simulated minus measured position, per joint, shape (2, J).
        torque_percent: ||simulated - measured|| / ||measured|| of torque, shape (2,).
    """

    position: Array
    torque_percent: Array


def closed_loop(models: Model3, runs: Sequence[Run], views: Sequence[View]) -> Closed | str:
    """Mismatch of simulations at the refitted and at the explained model, or why there is none.

    Args:
        views: Of the same recordings, whole, not averaged.
    """
    model = models.scene.model
    try:
        prepared = auxiliary.runs([run.signals for run in runs])
        position, torque, size, count = np.zeros((2, model.joints)), np.zeros(2), 0.0, 0
        for index, run in enumerate(prepared):
            tau = run.signals.tau_Nm
            for stretch in run.stretches:
                t = run.signals.t_s[stretch.rows][stretch.lead :]
                q = run.signals.q[stretch.rows][stretch.lead :]
                measured = tau[stretch.rows][stretch.lead :]
                skip = round(SETTLE_S / (t[1] - t[0]))
                size += float((measured[skip:] ** 2).sum())
                count += len(t) - skip
                for level, theta in enumerate((models.refitted, models.explained)):
                    extra = (
                        _extra(models, [v for v in views if v.motion.run == index], t) if level else np.zeros(q.shape)
                    )
                    simulated_q, simulated_tau = _simulate(models, stretch, theta, extra)
                    position[level] += ((simulated_q - q)[skip:] ** 2).sum(axis=0)
                    torque[level] += float(((simulated_tau - measured)[skip:] ** 2).sum())
    except ArmrigError as error:
        return f"No closed-loop simulation: {error}"
    return Closed(np.sqrt(position / count), 100 * np.sqrt(torque / size))


def _extra(models: Model3, views: Sequence[View], t_s: Array) -> Array:
    """Torque of all effects at some times, shape (T, J); zero outside of the views."""
    out = np.zeros((len(t_s), models.scene.joints))
    for view in views:
        torque = models.extra_torque(view)
        inside = (t_s >= view.motion.t_s[0]) & (t_s <= view.motion.t_s[-1])
        for j in range(models.scene.joints):
            out[inside, j] = np.interp(t_s[inside], view.motion.t_s, torque[:, j])
    return out


def _simulate(models: Model3, stretch: auxiliary.Stretch, theta: Array, extra: Array) -> tuple[Array, Array]:
    """Positions and torques of one stretch with a torque in addition to the model's."""
    model = models.scene.model
    step = float(stretch.reference.t_s[1] - stretch.reference.t_s[0])
    law = auxiliary.control(model, period_s=step, by_drives=stretch.by_drives)
    stiffness = law.axes.T @ np.diag(law.stiffness) @ law.axes
    early = np.arange(len(extra)) + (0.0 if stretch.by_drives else LEAD)
    ahead = np.column_stack([np.interp(early, np.arange(len(extra)), x) for x in extra.T])
    moved = stretch.reference.q - np.linalg.solve(stiffness, ahead.T).T
    reference = simulator.reference_of(moved, step)
    simulation = simulator.simulate(
        model.geometry,
        auxiliary.dynamics(model, theta),
        law,
        reference,
        substeps=auxiliary.SUBSTEPS,
        start=stretch.start,
    )
    # the torque of a row is the mean over the period before it
    torque = np.vstack([simulation.tau_Nm[:1], simulation.tau_Nm[:-1]]) + extra
    return simulation.q, torque
