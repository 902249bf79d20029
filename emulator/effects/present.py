"""The effects an arm has, by joint and parameter; those that only change a constant of rigid bodies and drives."""

from dataclasses import dataclass

import msgspec
import numpy as np

from emulator.kernels import Floats, Ints
from protocols.effectentries import check_effects
from protocols.robot import EffectEntry, Parameters, Robot

_STATIC = ("payload", "base.tilt", "drive.gain")  # everything else needs the extended physics


@dataclass(frozen=True)
class Present:
    """The effects of one arm, complete and checked."""

    robot: Robot
    entries: list[EffectEntry]

    @property
    def is_dynamic(self) -> bool:
        """More than rigid bodies, viscous and Coulomb friction are needed."""
        return any(entry.effect not in _STATIC for entry in self.entries)

    def of(self, effect: str) -> list[EffectEntry]:
        return [entry for entry in self.entries if entry.effect == effect]

    def joint(self, entry: EffectEntry) -> int:
        return self.robot.joint_names.index(entry.joint)

    def joints(self, effect: str) -> Ints:
        """Joints of all entries of an effect, shape (P,)."""
        return np.array([self.joint(entry) for entry in self.of(effect)], dtype=np.int64)

    def listed(self, effect: str, name: str) -> Floats:
        """One parameter of all entries of an effect, shape (P,)."""
        return np.array([entry.parameters[name] for entry in self.of(effect)], dtype=float)

    def by_joint(self, effect: str, name: str, absent: float = 0.0) -> Floats:
        """One parameter per joint; without a joint an entry stands for all, shape (J,)."""
        values = np.full(self.robot.joints, absent)
        for entry in self.of(effect):
            values[self.joint(entry) if entry.joint else slice(None)] = entry.parameters[name]
        return values


def present_in(robot: Robot) -> Present:
    """Effects of a robot file, and unlisted physics, which only a blind trial writes.

    Raises:
        ConfigError: As `check_effects`.
    """
    unlisted = [entry for entry in robot.effect if entry.effect == "unlisted"]
    listed = [entry for entry in robot.effect if entry.effect != "unlisted"]
    return Present(robot, check_effects(listed, robot, robot.name) + unlisted)


def with_static(present: Present) -> Robot:
    """The arm with payload and tilted base: rigid bodies as any other."""
    robot = present.robot
    joints, gravity = list(robot.joint), np.array(robot.gravity_m_s2)
    for entry in present.of("payload"):
        last = joints[-1]
        joints[-1] = msgspec.structs.replace(last, parameters=_loaded(last.parameters, entry.parameters))
    for entry in present.of("base.tilt"):
        gravity = tilted(gravity, entry.parameters["x_rad"], entry.parameters["y_rad"])
    return msgspec.structs.replace(robot, joint=joints, gravity_m_s2=tuple(gravity.tolist()))


def tilted(gravity: Floats, x_rad: float, y_rad: float) -> Floats:
    """Gravity in the frame of a base turned by x about its x, then by y about its new y, shape (3,)."""
    cx, sx, cy, sy = np.cos(x_rad), np.sin(x_rad), np.cos(y_rad), np.sin(y_rad)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    return np.asarray((about_x @ about_y).T @ gravity)


def _loaded(link: Parameters, load: dict[str, float]) -> Parameters:
    """Link with a body on it; Steiner's terms take its inertia to the link frame."""
    m, c = load["mass_kg"], np.array([load["x_m"], load["y_m"], load["z_m"]])
    inertia = load["inertia_kgm2"] * np.eye(3) + m * (c @ c * np.eye(3) - np.outer(c, c))
    rows, columns = np.triu_indices(3)
    mx, my, mz = (np.array(link.first_moment_kgm) + m * c).tolist()
    xx, xy, xz, yy, yz, zz = (np.array(link.inertia_kgm2) + inertia[rows, columns]).tolist()
    return msgspec.structs.replace(
        link, mass_kg=link.mass_kg + m, first_moment_kgm=(mx, my, mz), inertia_kgm2=(xx, xy, xz, yy, yz, zz)
    )


def true_gain(gain: Floats, present: Present) -> Floats:
    """Torque, or back-EMF, as it really is where the nominal one is `gain`, shape (J,)."""
    return np.asarray(gain * (1 + present.by_joint("drive.gain", "error")))
