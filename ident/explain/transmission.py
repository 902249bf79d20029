"""Hypotheses about what is between motor and link."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ident.explain import states
from ident.explain.contract import Parameter
from ident.explain.hypothesis import Flags, Hypothesis, Theta, parameter, scaled, within
from ident.explain.scene import Scene, View
from protocols.effects import Effect

Array = NDArray[np.float64]

LOWEST_HZ, STEPS, RATIO = 5.0, 24, 1.1  # grid of locked-motor resonances; 40 % steps miss them
ZETA = 0.05  # damping of an unknown gear
AMPLITUDE = (0.15, 2.5)  # of a simulated map; ideally 1, smaller where a share of the inertia sits on the motor
HEAVIER = 5.0  # rotor inertias: a link lighter than 1/5 of its rotor does not show its resonance


class Elasticity(Hypothesis):
    """A spring between motor and link: the link swings behind the motor."""

    effect: ClassVar[Effect] = "transmission.elasticity"
    group = "elastic gear"
    signature = "torque near a resonance that no static variable organises; grows with acceleration"
    experiments: ClassVar[tuple[str, ...]] = ("chirp",)

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        if scene.views[0].link_inertia[:, joint].max() <= 0:
            return []
        return [{"frequency_Hz": LOWEST_HZ * RATIO**k, "gap": 0.0, "zeta": ZETA} for k in range(STEPS)]

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        motion = view.motion
        inertia = view.link_inertia[:, joint]
        mean = self._inertia(scene, joint)
        if mean <= 0:
            return np.zeros((motion.samples, 1))
        inertia = np.maximum(inertia, 0.05 * mean)
        K = (2 * np.pi * theta["frequency_Hz"]) ** 2 * mean
        D = 2 * theta["zeta"] * np.sqrt(K * mean)
        load = view.load[:, joint]
        torque = states.elastic_torque(
            motion.q[:, joint],
            inertia,
            load - inertia * motion.qdd[:, joint],
            motion.dt_s,
            np.array([K]),
            np.array([D]),
            np.array([theta["gap"]]),
            circular=motion.circular,
        )[0]
        return np.asarray((torque - load)[:, None])

    def plausible(self, scene: Scene, joint: int, theta: Theta, c: Array) -> Flags:
        return within(c, *AMPLITUDE)

    def near(self, scene: Scene, joint: int, theta: Theta, step: float) -> list[Theta]:
        frequency = scaled(theta, "frequency_Hz", (1 / (1 + 0.05 * step), 1 + 0.05 * step))
        return [*frequency, *scaled(theta, "zeta", (1 / (1 + step), 1 + step))]

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        mean = self._inertia(scene, joint)
        K = (2 * np.pi * theta["frequency_Hz"]) ** 2 * mean
        D = 2 * theta["zeta"] * np.sqrt(K * mean)
        return [
            parameter(scene, joint, self.effect, "stiffness_Nm_rad", K, 0.08 * K),
            parameter(scene, joint, self.effect, "damping_Nms_rad", D, 0.5 * D),
        ]

    @staticmethod
    def _inertia(scene: Scene, joint: int) -> float:
        return float(np.mean([v.link_inertia[:, joint].mean() for v in scene.views]))


class Backlash(Elasticity):
    """A dead zone in front of that spring."""

    effect = "transmission.backlash"
    group = "elastic gear"
    signature = "bursts where the load changes its sign, and a resonance that depends on amplitude"
    experiments = ("chirp", "preload")
    FREQUENCIES_HZ: ClassVar[tuple[float, ...]] = (15.0, 25.0, 40.0)

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        if scene.views[0].link_inertia[:, joint].max() <= 0:
            return []
        span = max(float(np.ptp(v.motion.q[:, joint])) for v in scene.views)
        if span <= 0:
            return []
        return [
            {"frequency_Hz": f, "gap": float(g), "zeta": 0.15}
            for f in self.FREQUENCIES_HZ
            for g in np.geomspace(1e-4, 1e-2, 7) * span
        ]

    def near(self, scene: Scene, joint: int, theta: Theta, step: float) -> list[Theta]:
        gap = scaled(theta, "gap", (1 / (1 + 0.4 * step), 1 + 0.4 * step))
        frequency = scaled(theta, "frequency_Hz", (1 / (1 + 0.2 * step), 1 + 0.2 * step))
        return [*gap, *frequency, *scaled(theta, "zeta", (1 / (1 + 0.6 * step), 1 + 0.6 * step))]

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        gap = theta["gap"]
        spring = super().parameters(scene, joint, theta, c, std)
        return [parameter(scene, joint, self.effect, "gap_rad", gap, 0.1 * gap), *spring]


class Efficiency(Hypothesis):
    """A gear that loses a share of the power it transmits, another share when the link drives the motor."""

    effect = "transmission.efficiency"
    group = "load friction"
    signature = "friction that grows with transmitted torque and differs between driving and braking"
    experiments = ("payload",)
    curve = "load"
    complexity = 4.0

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        load, s = view.load[:, joint], scene.sign(view, joint)
        driving = load * view.motion.qd[:, joint] > 0
        return np.column_stack([np.abs(load) * s * driving, np.abs(load) * s * ~driving])

    def plausible(self, scene: Scene, joint: int, theta: Theta, c: Array) -> Flags:
        return np.asarray((c[0] > 0) & (c[0] < 2) & (c[1] > -0.2) & (c[1] < 1))

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        driving = 1 / (1 + c[0])
        return [
            parameter(scene, joint, self.effect, "driving", driving, std[0] * driving**2),
            parameter(scene, joint, self.effect, "braking", 1 - c[1], std[1]),
        ]


class Coupling(Hypothesis):
    """Parts that turn with two joints together: friction on v + ratio v(other)."""

    effect = "transmission.coupling"
    group = "coupling"
    whole = True
    signature = "friction on two joints at once that follows the sum of their speeds"
    experiments = ("single joints",)

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        if joint == 0 or scene.model.coupling[joint, joint - 1]:
            return []
        return [{"other": float(joint), "ratio": r} for r in (1.0, -1.0)]

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        other = int(theta["other"]) - 1
        row = np.zeros(scene.joints)
        row[joint], row[other] = 1.0, theta["ratio"]
        speed = view.motion.qd @ row
        soft = float(np.hypot(scene.soft[joint], theta["ratio"] * scene.soft[other]))
        both = np.column_stack([np.tanh(speed / soft), speed / max(scene.peak[joint], 1e-9)])
        return np.asarray(row[:, None, None] * both)

    def plausible(self, scene: Scene, joint: int, theta: Theta, c: Array) -> Flags:
        return np.asarray((c[0] >= 0) & (c[1] > -0.5 * np.abs(c[0])))

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        peak = max(scene.peak[joint], 1e-9)
        return [
            parameter(scene, joint, self.effect, "viscous_Nms_rad", max(c[1], 0.0) / peak, std[1] / peak),
            parameter(scene, joint, self.effect, "coulomb_Nm", c[0], std[0]),
            parameter(scene, joint, self.effect, "ratio", theta["ratio"], 0.0),
            parameter(scene, joint, self.effect, "other", theta["other"], 0.0),
        ]


class Spring(Hypothesis):
    """A spring, hose or cable that pulls the joint to a position."""

    effect = "spring"
    group = "spring"
    signature = "a torque that is a function of position and the same in both directions"
    experiments = ("static poses",)
    curve = "position"
    complexity = 4.0

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        return [{"cubic": 0.0}]

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        middle, half = self._range(scene, joint)
        x = (view.motion.q[:, joint] - middle) / half
        powers = [x, np.ones_like(x)] + ([x**2, x**3] if theta["cubic"] else [])
        return np.column_stack(powers)

    def plausible(self, scene: Scene, joint: int, theta: Theta, c: Array) -> Flags:
        steepest = c[0] + (3 * c[3] if theta["cubic"] else 0.0)
        return np.asarray((c[0] > 0) | (steepest > 0))

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        middle, half = self._range(scene, joint)
        stiffness, spread = c[0] / half, std[0] / half
        centre = middle - c[1] / stiffness if stiffness else middle
        out = [
            parameter(scene, joint, self.effect, "stiffness_Nm_rad", stiffness, spread),
            parameter(scene, joint, self.effect, "centre_rad", centre, abs(std[1] / stiffness) if stiffness else half),
        ]
        if theta["cubic"]:
            out.append(parameter(scene, joint, self.effect, "cubic_Nm_rad3", c[3] / half**3, std[3] / half**3))
        return out

    @staticmethod
    def _range(scene: Scene, joint: int) -> tuple[float, float]:
        q = np.concatenate([v.motion.q[:, joint] for v in scene.views])
        return float((q.max() + q.min()) / 2), max(float(np.ptp(q)) / 2, 1e-9)


class CubicSpring(Spring):
    """One that stiffens away from its centre."""

    complexity = 10.0

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        return [{"cubic": 1.0}]


TRANSMISSION: tuple[Hypothesis, ...] = (Elasticity(), Backlash(), Efficiency(), Coupling(), Spring(), CubicSpring())
