"""Control laws of the simulated arm: PD, PID and computed torque, in continuous time or in a computer."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emulator.dynamics import Dynamics, freeze
from emulator.law import Law
from protocols.errors import ConfigError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Control:
    """One joint control law: tau = A' clip(kp A (qr - q) + ki A int(qr - q) + kd A (w qdr - qd)).

    With `model`, computed torque: the bracket and the reference's acceleration are what the model's inverse dynamics is
    asked for. It adds dry friction in the reference's direction, so that it does not chatter.

    Attributes:
        stiffness, damping: kp [N·m/rad] and kd [N·m·s/rad], in computed torque [1/s²] and [1/s], shape (J,).
        integral: ki, `stiffness` per second, shape (J,). It does not stop where the torque is at its limit.
        speed_weight: w, 0 in the law of Janot et al. 2014 and 1 where errors of speed are fed back, shape (J,).
        limit_Nm: Largest torque on the axes of the law, shape (J,).
        axes: A, shape (J, J): identity for laws on joints, C for laws in drives whose motors turn with C qd.
        period_s: A sampled law is computed at this period and held; 0 for a law in continuous time.
        delay: Age of the positions that a torque answers, in periods.
        difference: Takes speed from two positions one period apart instead of the true one.
        model: What computed torque believes about the arm.
    """

    stiffness: Array
    damping: Array
    integral: Array
    speed_weight: Array
    limit_Nm: Array
    axes: Array
    period_s: float = 0.0
    delay: int = 0
    difference: bool = False
    model: Dynamics | None = None

    def __post_init__(self) -> None:
        J = len(self.stiffness)
        names = ("stiffness", "damping", "integral", "speed_weight", "limit_Nm")
        freeze(self, {**dict.fromkeys(names, (J,)), "axes": (J, J)})
        if self.delay < 0 or self.period_s < 0:
            raise ConfigError(
                f"A control law with period {self.period_s:g} s and delay {self.delay} cannot be simulated."
            )
        if self.period_s == 0 and (self.delay or self.difference):
            raise ConfigError("A delay, or speed from positions, needs a sampled control law: give its period.")
        if self.model is not None and not np.array_equal(self.axes, np.eye(J)):
            raise ConfigError("Computed torque acts on joints: leave the axes of the law out.")

    @classmethod
    def gains(
        cls,
        stiffness: ArrayLike,
        damping: ArrayLike,
        integral: ArrayLike = 0.0,
        *,
        speed_weight: ArrayLike = 0.0,
        limit_Nm: ArrayLike = np.inf,
        axes: Array | None = None,
        model: Dynamics | None = None,
    ) -> "Control":
        """A law in continuous time; `stiffness` lists the joints, scalars elsewhere hold for all of them."""
        kp = np.atleast_1d(np.asarray(stiffness, dtype=float))

        def every(value: ArrayLike) -> Array:
            return np.broadcast_to(np.asarray(value, dtype=float), kp.shape)

        A = np.eye(len(kp)) if axes is None else axes
        return cls(kp, every(damping), every(integral), every(speed_weight), every(limit_Nm), A, model=model)

    @classmethod
    def pd(cls, natural_frequency_rad_s: ArrayLike, damping: ArrayLike, inertia_kgm2: ArrayLike) -> "Control":
        """PD of Janot et al. 2014, eq. (19)-(21), in torque: kp kv J = w² J and kv J = 2 z w J.

        Gain updating (22) is this law with the inertia of the simulated arm in place of the a-priori one; see
        `emulator.simulator.axis_inertia`.
        """
        w, z, inertia = (np.asarray(x, dtype=float) for x in (natural_frequency_rad_s, damping, inertia_kgm2))
        return cls.gains(w**2 * inertia, 2 * z * w * inertia)

    @classmethod
    def computed_torque(
        cls, model: Dynamics, natural_frequency_rad_s: ArrayLike, damping: ArrayLike = 1.0
    ) -> "Control":
        """Inverse dynamics of `model`; errors decay as second-order systems."""
        w = np.broadcast_to(np.asarray(natural_frequency_rad_s, dtype=float), len(model.link))
        return cls.gains(w**2, 2 * np.asarray(damping) * w, speed_weight=1.0, model=model)

    def sampled(self, period_s: float, delay: int = 0, *, difference: bool = False) -> "Control":
        """The same law in a computer.

        The motion host of `emulator.host` is PD at the SYNC period with delay 1 and difference: what the drives latch
        at one SYNC is answered by the torque that starts at the next.
        """
        return replace(self, period_s=period_s, delay=delay, difference=difference)

    def law(self, hold: int) -> Law:
        """Arguments of the kernels.

        Args:
            hold: Integration steps per period; 0 in continuous time.
        """
        return Law(
            self.axes,
            int(not np.array_equal(self.axes, np.eye(len(self.axes)))),
            self.stiffness,
            self.damping,
            self.integral,
            self.speed_weight,
            self.limit_Nm,
            hold,
            self.delay,
            int(self.difference),
        )
