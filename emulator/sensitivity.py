"""How a simulated motion answers a small change of parameters, linearised along it.

With S = dq/dtheta, differentiating the model in closed loop gives a linear equation with one column per parameter,

    M S'' = d tau_c/dq S + d tau_c/dqd S' - d tau/dq S - d tau/dqd S' - W,

W being the regressor at the simulated motion and tau_c the control law. It costs less than one simulation where finite
differences cost one per parameter. Dry friction enters exactly: a row at rest stays at rest, and a speed that crosses
zero without resting loses the share that the jump of its friction takes.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.forward import Chain
from emulator.linearised import Loop, propagate
from emulator.simulator import Simulation
from protocols.errors import ConfigError

Array = NDArray[np.float64]

_WHOLE = 1e-6  # relative; a control period may miss a multiple of the sample step by this much


@dataclass(frozen=True)
class Sensitivities:
    """Change of a simulated motion per unit of each parameter.

    Attributes:
        q, tau_Nm: shape (J, T, P): joint, sample, parameter.
    """

    q: Array
    tau_Nm: Array


def midpoints(simulation: Simulation) -> tuple[Array, Array, Array]:
    """q, qd, qdd between each two samples, shape (T - 1, J): where `sensitivities` wants the regressor.

    The acceleration is the change of speed, so steps of a sampled law and of dry friction are averaged exactly.
    """
    q, qd = simulation.q, simulation.qd
    return (q[1:] + q[:-1]) / 2, (qd[1:] + qd[:-1]) / 2, np.diff(qd, axis=0) / simulation.step_s


def sensitivities(simulation: Simulation, regressor: Array) -> Sensitivities:
    """Sensitivities of positions and torques to the parameters whose columns are given, from the same start.

    The law must be sampled at a multiple of the sample step; one that is sampled faster is taken as continuous with
    its mean delay.

    Args:
        regressor: W at `midpoints`, shape (J, T - 1, P): all standard parameters, or base parameters that the
            simulation had instead of them.

    Raises:
        ConfigError: Shapes or periods do not fit.
    """
    T, J = simulation.q.shape
    if regressor.ndim != 3 or regressor.shape[:2] != (J, T - 1):
        raise ConfigError(
            f"The regressor has shape {regressor.shape}; sensitivities need it between the samples: ({J}, {T - 1}, P)."
        )
    place, control = simulation.geometry, simulation.control
    hold, lag_s = _sampling(simulation)
    q, tau = np.empty((J, T, regressor.shape[2])), np.empty((J, T, regressor.shape[2]))
    propagate(
        Chain(place.R0, place.p0, place.prismatic, place.gravity),
        simulation.dynamics.terms(),
        control.law(hold),
        None if control.model is None else control.model.terms(),
        Loop(simulation.q, simulation.qd, simulation.qdd, _free(simulation), simulation.step_s, lag_s),
        simulation.steepness,
        np.ascontiguousarray(regressor, dtype=float),
        q,
        tau,
    )
    return Sensitivities(q, tau)


def _sampling(simulation: Simulation) -> tuple[int, float]:
    """Samples per control period (0: continuous), and the delay of a law taken as continuous [s]."""
    control, step_s = simulation.control, simulation.step_s
    hold = round(control.period_s / step_s)
    if control.period_s < step_s * (1 - _WHOLE):
        return 0, (control.delay + 0.5) * control.period_s
    if abs(hold * step_s - control.period_s) > _WHOLE * step_s:
        raise ConfigError(
            f"The control period of {control.period_s * 1e3:g} ms is not a multiple of the sample step of"
            f" {step_s * 1e3:g} ms. Simulate on a grid that it is a multiple of."
        )
    return hold, 0.0


def _free(simulation: Simulation) -> Array:
    """1 where the torque of the law is below its limit, 0 where it is at it, shape (T, J)."""
    limit = simulation.control.limit_Nm
    if simulation.control.model is not None:
        command = simulation.tau_Nm
    else:
        command = np.asarray(np.linalg.solve(simulation.control.axes.T, simulation.tau_Nm.T).T, dtype=float)
    return np.asarray(np.abs(command) < limit * (1 - 1e-12), dtype=float)
