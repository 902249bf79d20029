"""Hypotheses about friction."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ident.explain import states
from ident.explain.contract import Parameter
from ident.explain.hypothesis import Flags, Hypothesis, Theta, parameter, positive, scaled, within
from ident.explain.scene import Scene, View

Array = NDArray[np.float64]

HALF_WIDTH = float(np.sqrt(2 * np.log(2)))  # of a Gaussian at half its height, in standard deviations


class Stribeck(Hypothesis):
    """More friction at low speed: (F_s - F_c) exp(-(|v|/v_s)^d) sign v; d = 0 is 1 / (1 + (v/v_s)²)."""

    effect = "friction.stribeck"
    group = "low-speed friction"
    signature = "extra friction at low speed that is the same on entering and on leaving a reversal"
    experiments = ("plateaus", "reversals")
    curve = "speed"

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        low = max(0.006 * scene.peak[joint], 1.5 * scene.soft[joint])
        speeds = np.geomspace(low, max(0.3 * scene.peak[joint], 2 * low), 8)
        return [{"speed": float(v), "exponent": d} for d in (1.0, 2.0) for v in speeds]

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        v = view.motion.qd[:, joint]
        x = np.abs(v) / theta["speed"]
        d = theta["exponent"]
        fall = 1 / (1 + x**2) if d == 0 else np.exp(-(x**d))
        return np.asarray((fall * scene.sign(view, joint))[:, None])

    def plausible(self, scene: Scene, joint: int, theta: Theta, c: Array) -> Flags:
        return np.asarray(positive(c) & (c[0] < 4 * scene.coulomb[joint] + 6 * np.sqrt(scene.floor[joint])))

    def near(self, scene: Scene, joint: int, theta: Theta, step: float) -> list[Theta]:
        speeds = scaled(theta, "speed", (1 / (1 + 0.3 * step), 1.0, 1 + 0.3 * step))
        return [{**t, "exponent": d} for t in speeds for d in (0.7, 1.0, 2.0, 0.0)]

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        v = theta["speed"]
        return [
            parameter(scene, joint, self.effect, "stiction_Nm", c[0], std[0]),
            parameter(scene, joint, self.effect, "velocity_rad_s", v, 0.1 * v),
            parameter(scene, joint, self.effect, "exponent", theta["exponent"] or 1.0, 0.3),
        ]


class Asymmetric(Hypothesis):
    """Other friction in the two directions; moving, a constant torque."""

    effect = "friction.asymmetric"
    group = "constant torque"
    signature = "a constant torque while the joint moves and none while it stands"
    experiments = ("standstill",)

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        return np.asarray(scene.sign(view, joint)[:, None] ** 2)

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        return [parameter(scene, joint, self.effect, "half_difference_Nm", c[0], std[0])]


class AsymmetricViscous(Asymmetric):
    """Other viscous friction in the two directions: a torque along |v|, and a constant while moving."""

    signature = "a torque that grows with speed and has the same sign in both directions"
    complexity = 4.0
    curve = "speed"

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        s = scene.sign(view, joint)
        v = view.motion.qd[:, joint]
        return np.column_stack([s**2, v * s])

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        viscous = Parameter("half_viscous_difference_Nms_rad", float(c[1]), float(std[1]), "torque per speed")
        return [parameter(scene, joint, self.effect, "half_difference_Nm", c[0], std[0]), viscous]


class ViscousNonlinear(Hypothesis):
    """Friction that does not grow in proportion to speed: c |v / v_max|^p sign v, or thinning lubricant,
    c asinh(v / v_0) / asinh(v_max / v_0) (Eyring 1936), which has no jump at standstill."""

    effect = "friction.viscous_nonlinear"
    group = "speed friction"
    signature = "a torque that is a curved, odd function of speed"
    experiments = ("plateaus",)
    curve = "speed"

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        powers = [{"exponent": p, "knee": 0.0} for p in (0.5, 1.5, 2.0, 3.0)]
        return [*powers, *({"exponent": 0.0, "knee": k} for k in (0.02, 0.05, 0.12, 0.3))]

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        x = view.motion.qd[:, joint] / scene.peak[joint]
        if theta["knee"]:
            return np.asarray(np.arcsinh(x / theta["knee"])[:, None] / np.arcsinh(1 / theta["knee"]))
        return np.asarray((np.abs(x) ** theta["exponent"] * scene.sign(view, joint))[:, None])

    def near(self, scene: Scene, joint: int, theta: Theta, step: float) -> list[Theta]:
        if theta["knee"]:
            return scaled(theta, "knee", (1 / (1 + 0.5 * step), 1 + 0.5 * step))
        p = theta["exponent"]
        return [{**theta, "exponent": max(0.3, p + d * step)} for d in (-0.25, 0.25) if abs(p + d * step - 1) > 0.15]

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        p = theta["exponent"]
        if theta["knee"]:  # its logarithmic slope at half of the largest speed
            x = 0.5 / theta["knee"]
            p = float(x / (np.sqrt(1 + x**2) * np.arcsinh(x)))
        return [
            parameter(scene, joint, self.effect, "torque_Nm", c[0], std[0]),
            parameter(scene, joint, self.effect, "velocity_rad_s", scene.peak[joint], 0.0),
            parameter(scene, joint, self.effect, "exponent", p, 0.2),
        ]


class Load(Hypothesis):
    """Friction of a loaded gear, mu |load| sign v."""

    effect = "friction.load"
    group = "load friction"
    signature = "friction that grows with the torque that the gear transmits"
    experiments = ("payload",)
    curve = "load"

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        return np.asarray((np.abs(view.load[:, joint]) * scene.sign(view, joint))[:, None])

    def plausible(self, scene: Scene, joint: int, theta: Theta, c: Array) -> Flags:
        return within(c, 0.0, 1.0)

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        return [parameter(scene, joint, self.effect, "coefficient", c[0], std[0])]


class Temperature(Hypothesis):
    """Friction that follows the motor's temperature: (T - T0) (a v + b sign v).

    Without a sensor, heat is a first-order state of the session's time.
    """

    effect = "friction.temperature"
    group = "temperature"
    signature = "friction that changes over the session, with its sign following the direction of motion"
    experiments = ("cold-warm",)

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        clock = np.concatenate([v.motion.clock_s[[0, -1]] for v in scene.views])
        if np.ptp(clock) < 20.0:
            return []
        sensed = all(v.motion.temperature_C is not None for v in scene.views)
        out: list[Theta] = [{"time_s": t, "sensor": 0.0, "start_s": float(clock.min())} for t in (60.0, 300.0, 1200.0)]
        if sensed and np.ptp(self._sensor(scene, joint)) > 0.5:
            out.insert(0, {"time_s": 0.0, "sensor": 1.0, "start_s": float(clock.min())})
        return out

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        rise = self._rise(view, joint, theta)
        rise = rise - self._mean(scene, joint, theta)
        return np.column_stack([rise * scene.sign(view, joint), rise * view.motion.qd[:, joint] / scene.peak[joint]])

    def plausible(self, scene: Scene, joint: int, theta: Theta, c: Array) -> Flags:
        change = np.abs(c).sum(axis=0)
        limit = 3 * scene.coulomb[joint] + abs(self._viscous(scene, joint)) * scene.peak[joint]
        return np.asarray(change * self._range(scene, joint, theta) < 2 * limit + 1e-9)

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        fc, fv = max(scene.coulomb[joint], 1e-9), max(abs(self._viscous(scene, joint)) * scene.peak[joint], 1e-9)
        out = [
            parameter(scene, joint, self.effect, "coulomb_per_K", c[0] / fc, std[0] / fc),
            parameter(scene, joint, self.effect, "viscous_per_K", c[1] / fv, std[1] / fv),
            parameter(scene, joint, self.effect, "reference_C", self._mean(scene, joint, theta), 0.0),
        ]
        if theta["sensor"]:
            return out
        # without a thermometer heat has no kelvin: relative to the whole way to the steady state
        rest = [Parameter(p.name.replace("_per_K", "_change"), p.value, p.std, "1", p.low, p.high) for p in out[:2]]
        time_s = theta["time_s"]
        return [*rest, parameter(scene, joint, self.effect, "time_constant_s", time_s, 0.5 * time_s)]

    def near(self, scene: Scene, joint: int, theta: Theta, step: float) -> list[Theta]:
        return [] if theta["sensor"] else scaled(theta, "time_s", (1 / (1 + step), 1 + step))

    @staticmethod
    def _rise(view: View, joint: int, theta: Theta) -> Array:
        if theta["sensor"] and view.motion.temperature_C is not None:
            return np.asarray(view.motion.temperature_C[:, joint])
        return np.asarray(1 - np.exp(-(view.motion.clock_s - theta["start_s"]) / theta["time_s"]))

    def _mean(self, scene: Scene, joint: int, theta: Theta) -> float:
        return float(np.mean([self._rise(v, joint, theta).mean() for v in scene.views]))

    def _range(self, scene: Scene, joint: int, theta: Theta) -> float:
        return float(np.ptp(np.concatenate([self._rise(v, joint, theta) for v in scene.views])))

    @staticmethod
    def _sensor(scene: Scene, joint: int) -> Array:
        return np.concatenate(
            [v.motion.temperature_C[:, joint] for v in scene.views if v.motion.temperature_C is not None]
        )

    @staticmethod
    def _viscous(scene: Scene, joint: int) -> float:
        return float(scene.theta[scene.model.names.index(f"Fv{joint + 1}")])


class Presliding(Hypothesis):
    """Friction that needs a distance to build up after a reversal: F_c (z / z_r - sign v)."""

    effect = "friction.presliding"
    group = "low-speed friction"
    signature = "friction that builds up over a distance after each reversal: it remembers where the joint turned"
    experiments = ("micro-strokes", "reversals")

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        span = max(float(np.ptp(np.concatenate([v.motion.q[:, joint] for v in scene.views]))), 1e-9)
        return [{"reach": float(r)} for r in np.geomspace(3e-4 * span, 0.06 * span, 9)]

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        step = np.diff(view.motion.q[:, joint], prepend=view.motion.q[:1, joint])
        if view.motion.circular:
            step[0] = view.motion.q[0, joint] - view.motion.q[-1, joint]
        z = states.dahl(step, np.array([theta["reach"]]), circular=view.motion.circular)[0]
        return np.asarray((z - scene.sign(view, joint))[:, None])

    def plausible(self, scene: Scene, joint: int, theta: Theta, c: Array) -> Flags:
        level = scene.coulomb[joint]
        return within(c, 0.3 * level, 2.5 * level + 1e-9)

    def near(self, scene: Scene, joint: int, theta: Theta, step: float) -> list[Theta]:
        return scaled(theta, "reach", (1 / (1 + 0.4 * step), 1 + 0.4 * step))

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        return [parameter(scene, joint, self.effect, "distance_rad", theta["reach"], 0.15 * theta["reach"])]


class PositionDependent(Hypothesis):
    """Friction of a worn or tight spot: A exp(-((q - q_c) / w)² / 2) sign v."""

    effect = "friction.position"
    group = "position friction"
    signature = "extra friction around one position, in both directions"
    experiments = ("slow pass",)
    curve = "position"
    WIDTHS: ClassVar[tuple[float, ...]] = (0.03, 0.08, 0.16)

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        q = np.concatenate([v.motion.q[:, joint] for v in scene.views])
        low, high = np.quantile(q, [0.01, 0.99])
        span = float(high - low)
        if span <= 0:
            return []
        out: list[Theta] = []
        for width in self.WIDTHS:
            centres = np.linspace(low, high, max(5, round(0.8 / width)))
            out += [{"centre": float(c), "width": width * span} for c in centres]
        return out

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        bump = np.exp(-0.5 * ((view.motion.q[:, joint] - theta["centre"]) / theta["width"]) ** 2)
        return np.asarray((bump * scene.sign(view, joint))[:, None])

    def plausible(self, scene: Scene, joint: int, theta: Theta, c: Array) -> Flags:
        return np.asarray(c[0] > -0.8 * scene.coulomb[joint])

    def near(self, scene: Scene, joint: int, theta: Theta, step: float) -> list[Theta]:
        shifted = [{**theta, "centre": theta["centre"] + d * step * theta["width"]} for d in (-0.4, 0.4)]
        return [*shifted, *scaled(theta, "width", (1 / (1 + 0.4 * step), 1 + 0.4 * step))]

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        half = HALF_WIDTH * theta["width"]
        return [
            parameter(scene, joint, self.effect, "amplitude_Nm", c[0], std[0]),
            parameter(scene, joint, self.effect, "centre_rad", theta["centre"], 0.1 * half),
            parameter(scene, joint, self.effect, "width_rad", half, 0.1 * half),
        ]


FRICTION: tuple[Hypothesis, ...] = (
    Stribeck(),
    Asymmetric(),
    AsymmetricViscous(),
    ViscousNonlinear(),
    Load(),
    Temperature(),
    Presliding(),
    PositionDependent(),
)
