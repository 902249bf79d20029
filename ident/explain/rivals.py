"""Rivals without physics: if one of them beats every named effect, the physics is not on the list."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ident.explain import states
from ident.explain.hypothesis import Hypothesis, Theta
from ident.explain.scene import Scene, View

Array = NDArray[np.float64]

POSITIONS, SPEEDS = 14, 12  # radial basis functions
MEMORIES_S = (0.1, 0.3, 0.6, 1.2)


class Rival(Hypothesis):
    """A shape that could be anything.

    Attributes:
        form: What it says about the unknown.
    """

    effect = "unlisted"
    group = "unlisted"
    form = ""
    organiser = ""


class AnyPosition(Rival):
    form = "a torque that depends on position and not on the direction of motion"
    organiser = "position"
    curve = "position"

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        return _bumps(view.motion.q[:, joint], _all(scene, joint, "q"), POSITIONS)


class AnyPositionFriction(Rival):
    form = "a friction that depends on position"
    organiser = "position × direction"
    curve = "position"

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        shape = _bumps(view.motion.q[:, joint], _all(scene, joint, "q"), POSITIONS)
        return shape * scene.sign(view, joint)[:, None]


class AnySpeed(Rival):
    form = "a torque that is a function of speed"
    organiser = "speed"
    curve = "speed"

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        v = view.motion.qd[:, joint] / scene.peak[joint]
        return _bumps(np.sign(v) * np.sqrt(np.abs(v)), np.array([-1.0, 1.0]), SPEEDS)


class AnyMemory(Rival):
    form = "a torque that remembers past motion: hysteresis, creep or a compliance"
    organiser = "past speed"

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        s = scene.sign(view, joint)
        dt = view.motion.dt_s
        if not view.motion.circular:
            return np.column_stack([states.lag(s, dt, T, 0.0) for T in MEMORIES_S])
        return np.column_stack([states.lag(s, dt, T, float(states.lag(s, dt, T, 0.0)[-1])) for T in MEMORIES_S])


class AnyCross(Rival):
    form = "a torque that depends on the motion of another joint"
    organiser = "another joint"

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        return [{"other": float(o)} for o in range(scene.joints) if o != joint]

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        o = int(theta["other"])
        v = view.motion.qd[:, o] / max(scene.peak[o], 1e-9)
        q = view.motion.q[:, o]
        return np.column_stack([v, scene.sign(view, o), v * np.sin(q), v * np.cos(q), np.sin(2 * q), np.cos(2 * q)])


RIVALS: tuple[Rival, ...] = (AnyPosition(), AnyPositionFriction(), AnySpeed(), AnyMemory(), AnyCross())


def _all(scene: Scene, joint: int, _: str) -> Array:
    return np.concatenate([v.motion.q[:, joint] for v in scene.views])


def _bumps(x: Array, span: Array, count: int) -> Array:
    low, high = float(span.min()), float(span.max())
    centres = np.linspace(low, high, count)
    width = max((high - low) / (count - 1), 1e-12)
    return np.asarray(np.exp(-0.5 * ((x[:, None] - centres) / width) ** 2))
