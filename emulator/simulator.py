"""The arm in closed loop, simulated from parameters alone: the auxiliary model of IDIM-IV, DIDIM and CLOE.

Rigid bodies, rotors, coupled motors and friction under the control law, Janot et al. 2014, eq. (17)-(22). Parameters
enter linearly and may be those of no body, as in the regular initialisation (24). What the emulated machine has beyond
that (current loops, brakes, noise, effects) is not here: this is what an identification assumes, not the truth.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.closed_loop import DONE, NOT_POSITIVE, leapfrog, runge_kutta
from emulator.control import Control
from emulator.dynamics import Dynamics
from emulator.forward import Chain
from emulator.law import Path
from emulator.step_limit import StepLimit, inertias
from protocols.errors import ConfigError, IdentificationError
from protocols.motion import Reference
from protocols.robot import Geometry

__all__ = ["Control", "Dynamics", "Exact", "Simulation", "Smooth", "axis_inertia", "reference_of", "simulate"]

Array = NDArray[np.float64]

_REGULAR = 1e-6  # relative; steps of a time grid may differ by this much


@dataclass(frozen=True)
class Exact:
    """Dry friction that holds a joint at rest until its Coulomb torque is exceeded; integrated by the leapfrog."""


@dataclass(frozen=True)
class Smooth:
    """Dry friction Fc tanh(k qd); integrated by fourth-order Runge-Kutta.

    Attributes:
        steepness_s_rad: k; None: for each row as steep as the step carries.
    """

    steepness_s_rad: float | None = None


@dataclass(frozen=True)
class Simulation:
    """One simulated motion on the grid of its reference.

    Torque and acceleration are those right after the sample, so they satisfy the inverse dynamic model there; a sampled
    law holds its torque until its next instant.

    Attributes:
        t_s: shape (T,) [s].
        q, qd, qdd, tau_Nm: Joint side, shape (T, J); qd of a joint at rest is exactly 0.
        geometry, dynamics, control: What was simulated.
        steepness: Of each row's dry friction, shape (K,) [s/rad]; infinite where it is exact.
    """

    t_s: Array
    q: Array
    qd: Array
    qdd: Array
    tau_Nm: Array
    geometry: Geometry
    dynamics: Dynamics
    control: Control
    steepness: Array

    @property
    def step_s(self) -> float:
        """Of the grid [s]."""
        return float(self.t_s[-1] - self.t_s[0]) / (len(self.t_s) - 1)


def simulate(
    geometry: Geometry,
    dynamics: Dynamics,
    control: Control,
    reference: Reference,
    *,
    substeps: int = 5,
    friction: Exact | Smooth = Exact(),
    start: tuple[Array, Array] | None = None,
) -> Simulation:
    """Direct dynamic model (17) in closed loop, at a fixed step.

    Args:
        reference: On a regular grid, which is also the grid of the result; cubic between its samples.
        substeps: Integration steps per sample.
        start: Position and speed of the first sample, shape (J,) each; the reference's where left out.

    Raises:
        ConfigError: Shapes, steps or periods that do not fit, or a step that is unstable for this friction or law.
        IdentificationError: The mass matrix of these parameters is not positive definite somewhere on the way, or the
            arm runs away.
    """
    step_s = _step(len(geometry.p0), dynamics, control, reference, substeps)
    h_s = step_s / substeps
    limit = StepLimit.on(geometry, dynamics, control, reference.q, h_s)
    law = control.law(_hold(control.period_s, h_s))
    model = None if control.model is None else control.model.terms()
    aim_q, aim_qd, aim_qdd = (np.ascontiguousarray(x, dtype=float) for x in (reference.q, reference.qd, reference.qdd))
    path = Path(aim_q, aim_qd, aim_qdd, step_s)
    first = np.array((reference.q[0], reference.qd[0]) if start is None else start, dtype=float)
    out = np.empty((4, *reference.q.shape))
    arm = Chain(geometry.R0, geometry.p0, geometry.prismatic, geometry.gravity), dynamics.terms()
    if isinstance(friction, Exact):
        limit.check_leapfrog()
        steepness = np.full(len(dynamics.dry_Nm), np.inf)
        outcome, n = leapfrog(*arm, law, model, path, first, substeps, out)
    else:
        k = friction.steepness_s_rad
        steepness = limit.steepest() if k is None else limit.check_steepness(k)
        outcome, n = runge_kutta(*arm, steepness, law, model, path, first, substeps, out)
    if outcome != DONE:
        raise _failure(outcome, n * step_s, out[0, max(n - 1, 0)])
    q, qd, qdd, tau = out
    return Simulation(reference.t_s, q, qd, qdd, tau, geometry, dynamics, control, steepness)


def axis_inertia(geometry: Geometry, dynamics: Dynamics, q: Array) -> Array:
    """J of each axis before eq. (19): the largest diagonal entry of M over positions of shape (T, J), shape (J,)."""
    return np.asarray(inertias(geometry, dynamics, q).diagonal(axis1=1, axis2=2).max(axis=0))


def reference_of(q: Array, step_s: float) -> Reference:
    """Reference of positions alone, shape (T, J); its derivatives are central differences."""
    qd = np.asarray(np.gradient(q, step_s, axis=0), dtype=float)
    qdd = np.asarray(np.gradient(qd, step_s, axis=0), dtype=float)
    return Reference(step_s * np.arange(len(q), dtype=float), q, qd, qdd)


def _step(J: int, dynamics: Dynamics, control: Control, reference: Reference, substeps: int) -> float:
    """Step of the reference's grid [s], everything having been found to fit."""
    counts = {
        "parameters": len(dynamics.link),
        "control law": len(control.stiffness),
        "reference": reference.q.shape[1],
    }
    for what, joints in counts.items():
        if joints != J:
            raise ConfigError(f"Number of joints: {joints} in the {what}, {J} in the arm.")
    for name, values in (("q", reference.q), ("qd", reference.qd), ("qdd", reference.qdd)):
        if not np.isfinite(values).all():
            n, j = (int(k) for k in np.argwhere(~np.isfinite(values))[0])
            raise ConfigError(
                f"The reference's {name} of joint {j + 1} is {values[n, j]} at sample {n}."
                " Simulate stretches without gaps."
            )
    T = len(reference.t_s)
    if T < 2 or substeps < 1:
        raise ConfigError(f"{T} samples with {substeps} substeps cannot be simulated; take at least 2 and 1.")
    step_s = float(reference.t_s[-1] - reference.t_s[0]) / (T - 1)
    worst_s = float(np.abs(np.diff(reference.t_s) - step_s).max())
    if not (step_s > 0 and worst_s <= _REGULAR * step_s):
        raise ConfigError(
            f"The reference's time grid is not regular: its steps differ from {step_s:.6g} s by up to {worst_s:.3g} s."
            " Resample it."
        )
    return step_s


def _hold(period_s: float, h_s: float) -> int:
    """Integration steps per control period."""
    hold = round(period_s / h_s)
    if abs(hold * h_s - period_s) > _REGULAR * h_s:
        raise ConfigError(
            f"The control period of {period_s * 1e3:g} ms is not a multiple of the integration step of"
            f" {h_s * 1e3:g} ms. Change the number of substeps."
        )
    return hold


def _failure(outcome: int, t_s: float, q: Array) -> IdentificationError:
    where = f"{t_s:.3f} s after the start, near q = {np.array2string(q, precision=3)} rad"
    if outcome == NOT_POSITIVE:
        return IdentificationError(
            f"The mass matrix of these parameters is not positive definite {where}, so the simulation ends there."
            " Use parameters closer to those of an arm, or gains that keep it on its reference."
        )
    return IdentificationError(
        f"The simulated arm ran away {where}. The control law does not hold it with these parameters: update the gains"
        " to its inertia (axis_inertia), or use more substeps."
    )
