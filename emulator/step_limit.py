"""Which integration steps carry the damping of an arm, its friction and its control law.

A joint of inertia I with dry friction Fc tanh(k qd) loses speed at the rate Fc k / I around zero. An explicit method
follows that only while step times rate stays inside its region of stability; outside, the simulated joint shakes at
the step frequency, and neither the result nor any error message of the integrator shows it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.control import Control
from emulator.dynamics import Dynamics
from emulator.kernels import mass_matrix
from protocols.errors import ConfigError, IdentificationError
from protocols.robot import Geometry

Array = NDArray[np.float64]

RUNGE_KUTTA = 2.785  # step times rate on the negative real axis, fourth order
LEAPFROG = 1.0  # step times rate of a continuous law, whose torque it computes from an extrapolated speed
AUTOMATIC = 2.0  # of RUNGE_KUTTA for a steepness chosen here: inertia changes between the poses looked at
SOFTEST_S_RAD = 5.0  # tanh(k qd) is 0.76 at 1/k = 0.2 rad/s; friction smeared further than that is not dry
_POSES = 64  # of a motion


def inertias(geometry: Geometry, dynamics: Dynamics, q: Array) -> Array:
    """M at positions spread over a motion, shape (at most 127, J, J)."""
    place = geometry.R0, geometry.p0, geometry.prismatic
    poses = np.ascontiguousarray(q[:: max(1, len(q) // _POSES)], dtype=float)
    return np.array([mass_matrix(*place, dynamics.link, pose) + dynamics.rotor for pose in poses])


@dataclass(frozen=True)
class StepLimit:
    """An arm on one motion at one integration step.

    Attributes:
        step_s: Integration step.
        roots: Inverse Cholesky factors of M at poses of the motion, shape (N, J, J).
        dynamics, control: What is simulated.
    """

    step_s: float
    roots: Array
    dynamics: Dynamics
    control: Control

    @classmethod
    def on(cls, geometry: Geometry, dynamics: Dynamics, control: Control, q: Array, step_s: float) -> "StepLimit":
        """On the motion q, shape (T, J).

        Raises:
            IdentificationError: The mass matrix is not positive definite somewhere on it.
        """
        M = inertias(geometry, dynamics, q)
        try:
            roots = np.linalg.inv(np.linalg.cholesky(M))
        except np.linalg.LinAlgError:
            raise IdentificationError(
                f"The mass matrix of these parameters is not positive definite on this motion (smallest eigenvalue"
                f" {np.linalg.eigvalsh(M).min():.3g} kg·m²), so they cannot be simulated. Start from the regular"
                " initialisation, or leave out parameters that the motion does not show."
            ) from None
        return cls(step_s, roots, dynamics, control)

    def _rate(self, D: Array) -> float:
        """Fastest decay by a damping matrix D, shape (J, J), at any pose [1/s]."""
        return float(np.linalg.eigvalsh(self.roots @ D @ self.roots.transpose(0, 2, 1)).max())

    def _control_damping(self) -> Array:
        if self.control.period_s > 0:
            return np.zeros_like(self.dynamics.viscous)
        if self.control.model is not None:  # kd M: joints decay at kd whatever the model's inertia, if it is right
            return np.asarray(self.control.damping.max() * np.linalg.inv(self.roots[0].T @ self.roots[0]))
        return self.control.axes.T @ (self.control.damping[:, None] * self.control.axes)

    def _dry_damping(self, steepness: Array) -> Array:
        B = self.dynamics.dry_rows
        return B.T @ ((np.maximum(self.dynamics.dry_Nm, 0.0) * steepness)[:, None] * B)

    def check_leapfrog(self) -> None:
        """Friction is implicit there; only a continuous law is not.

        Raises:
            ConfigError: The step is too long.
        """
        rate = self._rate(self._control_damping())
        self._refuse(LEAPFROG, rate, f"The control law damps at {rate:.4g}/s", "step times rate", "")

    def check_steepness(self, steepness_s_rad: float) -> Array:
        """Steepness of each row, shape (K,).

        Raises:
            ConfigError: The step is too long.
        """
        k = np.full(len(self.dynamics.dry_Nm), steepness_s_rad)
        rate = self._rate(self.dynamics.viscous + self._control_damping() + self._dry_damping(k))
        what = f"Dry friction of steepness {steepness_s_rad:g} s/rad decays at {rate:.4g}/s"
        self._refuse(RUNGE_KUTTA, rate, what, "h Fc k / I", ", a lower steepness or exact friction")
        return k

    def steepest(self) -> Array:
        """The largest steepness of each row that the step carries, rows sharing it equally, shape (K,).

        Raises:
            ConfigError: It is too small for dry friction, or the rest of the arm leaves no room.
        """
        dry, B = np.maximum(self.dynamics.dry_Nm, 0.0), self.dynamics.dry_rows
        smooth = self._rate(self.dynamics.viscous + self._control_damping())
        self._refuse(AUTOMATIC, smooth, f"Viscous friction and control damp at {smooth:.4g}/s", "step times rate", "")
        k = np.full(len(dry), np.inf)
        if not dry.any():
            return np.ones(len(dry))
        mobility = (np.einsum("kj,nij->nki", B, self.roots) ** 2).sum(axis=2).max(axis=0)
        np.divide(1.0, dry * mobility, out=k, where=dry > 0)
        k[dry == 0] = k[dry > 0].min()
        k *= (AUTOMATIC / self.step_s - smooth) / self._rate(self._dry_damping(k))
        if k.min() < SOFTEST_S_RAD:
            row = int(np.argmin(k))
            raise ConfigError(
                f"A step of {self.step_s * 1e3:.4g} ms carries dry friction of {dry[row]:.3g} N·m only with a steepness"
                f" of {k[row]:.3g} s/rad, below {SOFTEST_S_RAD:g}, which is viscous friction by another name. Use more"
                " substeps or exact friction."
            )
        return k

    def _refuse(self, limit: float, rate: float, what: str, name: str, otherwise: str) -> None:
        number = self.step_s * rate
        if number > limit:
            raise ConfigError(
                f"{what}, which a step of {self.step_s * 1e3:.4g} ms does not carry ({name} = {number:.3g}, limit"
                f" {limit:g}). Use {int(np.ceil(number / limit))} times the substeps{otherwise}."
            )
