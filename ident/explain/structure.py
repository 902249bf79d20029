"""Hypotheses about the whole arm: what it carries and what it stands on."""

from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from ident.explain.contract import Parameter
from ident.explain.hypothesis import Flags, Hypothesis, Theta, parameter, positive
from ident.explain.scene import Scene, View
from ident.kernels import inertial_regressor
from protocols.robot import Geometry

Array = NDArray[np.float64]


class Payload(Hypothesis):
    """A body on the last link: mass and first moments that the prior does not believe in."""

    effect = "payload"
    group = "scale of torque"
    whole = True
    signature = "more mass at the end of the arm than is believed; it moves all joints' torques together"
    experiments = ("known mass", "tool off")

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        return [{}] if joint == 0 else []

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        J = scene.joints
        m = view.motion
        W = inertial_regressor(scene.model.geometry, m.q, m.qd, m.qdd)[:, :, 10 * (J - 1) :]
        if scene.model.geometry.prismatic[J - 1] and J == 1:
            return W[:, :, [0]]
        return W[:, :, :4]

    def plausible(self, scene: Scene, joint: int, theta: Theta, c: Array) -> Flags:
        mass = c[0]
        reach = np.sqrt((c[1:4] ** 2).sum(axis=0)) if len(c) > 1 else np.zeros_like(mass)
        return np.asarray((mass > 0) & (reach < 1.5 * mass))

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        out = [parameter(scene, -1, self.effect, "mass_kg", c[0], std[0])]
        for name, value, spread in zip(("x_m", "y_m", "z_m"), c[1:], std[1:], strict=False):
            out.append(parameter(scene, -1, self.effect, name, value / c[0], spread / abs(c[0])))
        return out


class Tilt(Hypothesis):
    """A base that does not stand upright: gravity along its own x and y."""

    effect = "base.tilt"
    group = "constant torque"
    whole = True
    signature = "a pattern of gravity torques over all joints that turns with the first axis"
    experiments = ("turntable",)

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        return [{}] if joint == 0 and np.any(np.array(scene.model.robot.gravity_m_s2)) else []

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        geometry = scene.model.geometry
        q = view.motion.q[view.low.at]  # gravity torques are as smooth as positions
        zero = np.zeros_like(q)
        links = scene.theta[: 10 * scene.joints]
        out = []
        for turn in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)):
            # seen from a base turned by R = I + [turn]x, gravity is R'g = g - turn x g
            changed = msgspec.structs.replace(geometry, gravity=-np.cross(turn, geometry.gravity))
            out.append(inertial_regressor(changed, q, zero, zero) @ links)
        columns = np.stack(out, axis=-1)
        rows = np.arange(view.motion.samples)
        return np.stack(
            [[np.interp(rows, view.low.at, columns[j, :, k]) for k in range(2)] for j in range(scene.joints)]
        ).transpose(0, 2, 1)

    def plausible(self, scene: Scene, joint: int, theta: Theta, c: Array) -> Flags:
        return np.asarray((np.abs(c) < 0.5).all(axis=0))

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        return [
            parameter(scene, -1, self.effect, "x_rad", c[0], std[0]),
            parameter(scene, -1, self.effect, "y_rad", c[1], std[1]),
        ]


class BaseFlexibility(Hypothesis):
    """A base that rocks about x or y, or slides along the first prismatic axis, under the arm's reaction.

    The base follows the reaction as an oscillator of second order; its acceleration is one more joint before the
    first, and its angle tilts gravity.
    """

    effect = "base.flexibility"
    group = "flexible base"
    whole = True
    signature = "the same resonance on several joints, driven by the arm's reaction on its base"
    experiments = ("accelerometer",)

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        if joint:
            return []
        axes = (2.0,) if scene.joints == 1 else (0.0, 1.0)
        return [{"frequency_Hz": float(f), "axis": a} for a in axes for f in np.geomspace(5.0, 40.0, 9)]

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        axis = int(theta["axis"])
        links = scene.theta[: 10 * scene.joints]
        slides = scene.joints == 1
        key = f"base {axis}"
        if key not in view.cache:
            tilted = np.zeros(0) if slides else _tilted(scene, view, links, axis)
            view.cache[key] = (*_base_torque(scene.model.geometry, view, links, axis, slides=slides), tilted)
        wrench, carried, tilted = view.cache[key]
        angle, acceleration = _oscillation(wrench, view, theta["frequency_Hz"])
        load = (carried * acceleration[:, None]).T
        if not slides:
            load = load + tilted * angle
        return load[:, :, None]

    def plausible(self, scene: Scene, joint: int, theta: Theta, c: Array) -> Flags:
        return positive(c)

    def near(self, scene: Scene, joint: int, theta: Theta, step: float) -> list[Theta]:
        f = theta["frequency_Hz"]
        return [{**theta, "frequency_Hz": f * x} for x in (1 / (1 + 0.12 * step), 1 + 0.12 * step)]

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        f = theta["frequency_Hz"]
        inertia = 1 / max(float(c[0]) * (2 * np.pi * f) ** 2, 1e-12)  # 1 / stiffness = c
        return [
            parameter(scene, -1, self.effect, "frequency_Hz", f, 0.06 * f),
            parameter(scene, -1, self.effect, "inertia_kgm2", inertia, inertia * float(std[0] / max(c[0], 1e-12))),
        ]


def _extended(geometry: Geometry, axis: int, *, slides: bool) -> Geometry:
    """The chain on one more joint about (or along) an axis of its base."""
    turn = [
        np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),  # its z is the base's x
        np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),  # its z is the base's y
        np.eye(3),
    ][axis]
    if slides:
        turn = geometry.R0[0]  # along the first axis itself
    R0 = np.concatenate([turn[None], (turn.T @ geometry.R0[0])[None], geometry.R0[1:]])
    p0 = np.concatenate([np.zeros((1, 3)), (turn.T @ geometry.p0[0])[None], geometry.p0[1:]])
    prismatic = np.concatenate([[int(slides)], geometry.prismatic])
    return msgspec.structs.replace(geometry, R0=R0, p0=p0, prismatic=prismatic)


def _base_torque(geometry: Geometry, view: View, links: Array, axis: int, *, slides: bool) -> tuple[Array, Array]:
    """Torque that the arm asks of its base, shape (T,), and what each joint feels per unit of the base's
    acceleration, shape (T, J)."""
    m = view.motion
    longer = _extended(geometry, axis, slides=slides)
    body = np.concatenate([np.zeros(10), links])

    def on(values: Array, base: float = 0.0) -> Array:
        return np.column_stack([np.full(len(values), base), values])

    zero = np.zeros_like(m.q)
    reaction = inertial_regressor(longer, on(m.q), on(m.qd), on(m.qdd))[0] @ body
    still = inertial_regressor(longer, on(m.q), on(zero), on(zero)) @ body
    pushed = inertial_regressor(longer, on(m.q), on(zero), on(zero, 1.0)) @ body
    return np.asarray(reaction - still[0]), np.asarray((pushed - still)[1:].T)


def _oscillation(torque: Array, view: View, frequency_Hz: float, damping: float = 0.04) -> tuple[Array, Array]:
    """Angle times stiffness of an oscillator under minus a torque, and its second derivative, shapes (T,)."""
    dt = view.motion.dt_s
    pad = 0 if view.motion.circular else round(1.0 / dt)
    x = np.concatenate([torque[:1].repeat(pad), torque, torque[-1:].repeat(pad)]) if pad else torque
    w = 2 * np.pi * np.fft.rfftfreq(len(x), dt)
    natural = 2 * np.pi * frequency_Hz
    response = natural**2 / (natural**2 - w**2 + 2j * damping * natural * w)
    spectrum = -np.fft.rfft(x) * response
    angle = np.fft.irfft(spectrum, len(x))
    acceleration = np.fft.irfft(-(w**2) * spectrum, len(x))
    rows = slice(pad, pad + len(torque))
    return np.asarray(angle[rows]), np.asarray(acceleration[rows])


def _tilted(scene: Scene, view: View, links: Array, axis: int) -> Array:
    """Change of gravity torques per angle of the base, shape (J, T)."""
    unit = np.eye(3)[axis]
    geometry = scene.model.geometry
    zero = np.zeros_like(view.motion.q)
    changed = msgspec.structs.replace(geometry, gravity=-np.cross(unit, geometry.gravity))
    return np.asarray(inertial_regressor(changed, view.motion.q, zero, zero) @ links)


STRUCTURE: tuple[Hypothesis, ...] = (Payload(), Tilt(), BaseFlexibility())
