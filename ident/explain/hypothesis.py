"""One hypothesis per effect: what torque it would add to a motion that was measured."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ident.explain.contract import Parameter
from ident.explain.scene import Scene, View
from protocols.effectparams import EFFECT_KINDS
from protocols.effects import Effect

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Theta = Mapping[str, float]


@dataclass(frozen=True)
class Hypothesis:
    """One effect of the vocabulary. Subclasses say what its columns are.

    Columns are torques that the drive has to give in addition to the base model's, on the measured motion; those of
    effects with a hidden state are driven by that motion, so no closed loop is simulated.

    Attributes:
        effect: Key of the vocabulary.
        group: Effects that recordings of motion can hardly tell apart share it.
        whole: Columns concern all joints at once, shape (J, T, m); else one joint, shape (T, m).
        complexity: Nats that its extra shape columns cost.
        signature: How it shows itself, in words.
        experiments: Keys of `experiments.LIBRARY` that tell it from its rivals.
        curve: Variable it is a function of: "speed", "position", "load" or "".
    """

    effect: ClassVar[Effect]
    group: ClassVar[str]
    whole: ClassVar[bool] = False
    complexity: ClassVar[float] = 0.0
    signature: ClassVar[str]
    experiments: ClassVar[tuple[str, ...]] = ()
    curve: ClassVar[str] = ""

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        """Nonlinear parameters to try; empty where the effect cannot exist."""
        return [{}]

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        """See `whole`."""
        raise NotImplementedError

    def plausible(self, scene: Scene, joint: int, theta: Theta, c: Array) -> Flags:
        """Which coefficients physics permits; c of shape (m, D), result (D,)."""
        return np.ones(c.shape[1], dtype=bool)

    def near(self, scene: Scene, joint: int, theta: Theta, step: float) -> list[Theta]:
        """Neighbours of theta for a local search; step 1 is half a grid step."""
        return []

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        """Physical parameters in the names that robot files use; c and std of shape (m,)."""
        raise NotImplementedError

    def because(self, scene: Scene, joint: int, theta: Theta, c: Array) -> str:
        """Why, in words."""
        return self.signature


def positive(c: Array) -> Flags:
    """Plausible where the first coefficient is."""
    return np.asarray(c[0] > 0)


def within(c: Array, low: float, high: float) -> Flags:
    return np.asarray((c[0] >= low) & (c[0] <= high))


def scaled(theta: Theta, key: str, factors: Sequence[float]) -> list[Theta]:
    """Copies of theta with one value multiplied."""
    return [{**theta, key: theta[key] * f} for f in factors]


def parameter(scene: Scene, joint: int, effect: Effect, name: str, value: float, std: float) -> Parameter:
    """Parameter of the shared vocabulary, with the unit of this kind of joint."""
    kind = next(p for p in EFFECT_KINDS[effect].parameters if p.name == name)
    unit = kind.unit
    if joint >= 0 and scene.model.geometry.prismatic[joint]:
        unit = unit.replace("N·m", "N").replace("rad", "m") if unit != "rad" or "phase" not in name else unit
    return Parameter(name, float(value), float(std), unit or "1", float(value - 1.96 * std), float(value + 1.96 * std))


def gear(scene: Scene, joint: int) -> float:
    """Motor angle per joint angle, unsigned."""
    return abs(scene.model.robot.joint[joint].drive.gear_ratio)
