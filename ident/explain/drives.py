"""Hypotheses about motor, power stage and sensors."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from ident.explain.contract import Parameter
from ident.explain.hypothesis import Flags, Hypothesis, Theta, gear, parameter, positive, within
from ident.explain.scene import Scene, View
from protocols.effects import Effect

Array = NDArray[np.float64]

EARLIEST_S, LATEST_S = -0.02, 0.05  # a commanded current is ahead of the torque, a measured one behind


class CurrentOffset(Hypothesis):
    """A current sensor that does not read zero at zero current."""

    effect = "drive.current_offset"
    group = "constant torque"
    signature = "a constant torque, also at standstill"
    experiments = ("standstill",)

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        return np.ones((view.motion.samples, 1))

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        drive = scene.model.robot.joint[joint].drive
        per_A = drive.drive_gain_Nm_A * np.sign(drive.gear_ratio)
        return [parameter(scene, joint, self.effect, "offset_A", c[0] / per_A, std[0] / abs(per_A))]


class Gain(Hypothesis):
    """A drive gain other than the nominal one: all torques of the joint are scaled."""

    effect = "drive.gain"
    group = "scale of torque"
    signature = "all torques of the joint are larger or smaller than masses and inertias that are believed allow"
    experiments = ("known mass",)

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        return view.total[:, [joint]].copy()

    def plausible(self, scene: Scene, joint: int, theta: Theta, c: Array) -> Flags:
        return within(c, -0.6, 1.5)

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        error = 1 / (1 + c[0]) - 1
        return [parameter(scene, joint, self.effect, "error", error, std[0] * (1 + error) ** 2)]


class Delay(Hypothesis):
    """Currents older than their time stamp says, on one joint."""

    effect = "drive.delay"
    group = "timing"
    signature = "torque errors in proportion to the rate of change of torque, in bursts at reversals"
    experiments = ("dither",)

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        return -_rate(_smooth_torque(scene, view)[:, [joint]], view)

    def plausible(self, scene: Scene, joint: int, theta: Theta, c: Array) -> Flags:
        measured = all(view.motion.measured for view in scene.views)
        return within(c, 0.0 if measured else EARLIEST_S, LATEST_S)

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        return [parameter(scene, joint, self.effect, "delay_s", c[0], std[0])]


class CommonDelay(Delay):
    """The same of all joints."""

    whole = True

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        return [{}] if joint == 0 and scene.joints > 1 else []

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        return -_rate(_smooth_torque(scene, view), view).T[:, :, None]


class Saturation(Hypothesis):
    """A torque constant that falls with the square of current."""

    effect = "motor.saturation"
    group = "saturation"
    signature = "more current than in proportion at large torque, in both directions of motion"
    experiments = ("static load",)
    curve = "load"

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        drive = scene.model.robot.joint[joint].drive
        full = drive.drive_gain_Nm_A * drive.max_current_A
        total = view.total[:, [joint]]
        return np.asarray(total * (total / full) ** 2)

    def plausible(self, scene: Scene, joint: int, theta: Theta, c: Array) -> Flags:
        return positive(c)

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        drive = scene.model.robot.joint[joint].drive
        full = drive.drive_gain_Nm_A * drive.max_current_A
        used = max(float(np.abs(v.total[:, joint]).max()) for v in scene.views) / full
        return [
            parameter(scene, joint, self.effect, "loss", c[0] * used**2, std[0] * used**2),
            parameter(scene, joint, self.effect, "current_A", used * drive.max_current_A, 0.0),
        ]


class Ripple(Hypothesis):
    """Torque harmonics of the motor's angle. Orders come from the scan at full bandwidth (`explain.ripple`).

    theta holds "order", and for a series of harmonics "order2", "order3", ... besides.
    """

    effect: ClassVar[Effect] = "motor.ripple"
    group = "ripple"
    signature = "a torque that repeats with position, of the same size at every speed"
    experiments = ("slow pass",)

    def grid(self, scene: Scene, joint: int) -> Sequence[Theta]:
        return []

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        return harmonics(view.motion.q[:, joint] * gear(scene, joint), theta)

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        sign = np.sign(scene.model.robot.joint[joint].drive.gear_ratio)  # the motor may turn against its joint
        out: list[Parameter] = []
        for k, order in enumerate(theta.values()):
            sine, cosine = c[2 * k], c[2 * k + 1]
            amplitude = float(np.hypot(sine, cosine))
            spread = float(np.hypot(std[2 * k], std[2 * k + 1]) / np.sqrt(2))
            number = "" if k == 0 else f"#{k + 1}"  # of the harmonic; robot files get an entry for each
            for p in (
                parameter(scene, joint, self.effect, "amplitude_Nm", amplitude, spread),
                parameter(scene, joint, self.effect, "order", order, 0.0),
                parameter(
                    scene,
                    joint,
                    self.effect,
                    "phase_rad",
                    float(np.arctan2(cosine, sign * sine)),
                    spread / max(amplitude, 1e-12),
                ),
            ):
                out.append(replace(p, name=p.name + number))
        return out

    def because(self, scene: Scene, joint: int, theta: Theta, c: Array) -> str:
        if len(theta) == 1:
            return f"{self.signature} (order {theta['order']:g} of the motor)"
        low, high = min(theta.values()), max(theta.values())
        return f"{self.signature} ({len(theta)} harmonics of the motor's angle, {low:g} to {high:g})"


class Eccentricity(Ripple):
    """An encoder off its axis: positions, and so accelerations, have harmonics that the machine has not."""

    effect = "sensor.eccentricity"
    group = "ripple"
    signature = "a torque that repeats with position and grows with the square of speed"
    experiments = ("slow pass",)

    def columns(self, scene: Scene, view: View, joint: int, theta: Theta) -> Array:
        motion = view.motion
        n = theta["order"] * gear(scene, joint)
        angle = n * motion.q[:, joint]
        v, a = motion.qd[:, joint], motion.qdd[:, joint]
        inertia = view.axis_inertia[:, joint]
        # the controller follows the false position; what the base model is charged with in vain is -J d²(error)/dt²
        s, c = np.sin(angle), np.cos(angle)
        return np.column_stack([-inertia * (n * a * c - (n * v) ** 2 * s), inertia * (n * a * s + (n * v) ** 2 * c)])

    def parameters(self, scene: Scene, joint: int, theta: Theta, c: Array, std: Array) -> list[Parameter]:
        spread = float(np.hypot(*std) / np.sqrt(2))
        amplitude = float(np.hypot(c[0], c[1]))
        return [
            parameter(scene, joint, self.effect, "amplitude_rad", amplitude, spread),
            parameter(scene, joint, self.effect, "order", theta["order"], 0.0),
            parameter(
                scene, joint, self.effect, "phase_rad", float(np.arctan2(c[1], c[0])), spread / max(amplitude, 1e-15)
            ),
        ]


def harmonics(motor_angle: Array, theta: Theta) -> Array:
    """Sine and cosine of each order, shape (T, 2 orders)."""
    angles = motor_angle[:, None] * np.array(list(theta.values()))
    out = np.empty((len(angles), 2 * angles.shape[1]))
    out[:, ::2], out[:, 1::2] = np.sin(angles), np.cos(angles)
    return out


def _smooth_torque(scene: Scene, view: View) -> Array:
    """All torque but dry friction, shape (T, J): a joint that sticks when it turns swings its friction early, which is
    no error of time."""
    dry = [scene.coulomb[j] * scene.sign(view, j) for j in range(scene.joints)]
    return np.asarray(view.total - np.column_stack(dry))


def _rate(total: Array, view: View) -> Array:
    """Time derivative of shape (T, J)."""
    if view.motion.circular:
        ahead, behind = np.roll(total, -1, axis=0), np.roll(total, 1, axis=0)
        return np.asarray((ahead - behind) / (2 * view.motion.dt_s))
    return np.asarray(np.gradient(total, view.motion.dt_s, axis=0))


DRIVES: tuple[Hypothesis, ...] = (
    CurrentOffset(),
    Gain(),
    Delay(),
    CommonDelay(),
    Saturation(),
    Ripple(),
    Eccentricity(),
)
