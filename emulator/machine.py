"""The emulated truth of a rig: the robot file that says how the machine really is. Never leaves the emulator."""

from importlib import resources
from pathlib import Path

import msgspec

from protocols import config
from protocols.effectentries import check_effects
from protocols.effectparams import EFFECT_KINDS
from protocols.effects import Effect
from protocols.errors import ConfigError
from protocols.rig import Rig
from protocols.robot import Robot

SHIPPED = "machines"  # package folder with the machines that come with armrig
EMULATED_EFFECTS: tuple[Effect, ...] = tuple(EFFECT_KINDS)


def load_machine(rig: Rig, robot: Robot, base: Path | None = None) -> Robot:
    """The machine of a rig, with the effects of its own file and those of the rig's `[[emulated.effect]]`.

    Args:
        robot: The rig's nominal robot, which the machine is where the rig names no other.
        base: Folder of the rig file, where a relative path starts.

    Raises:
        ConfigError: No such machine; a file that is no robot; other joints than the nominal robot's; an effect that
            this arm cannot have.
    """
    name = rig.emulated.machine
    machine = robot if name is None else config.read(_locate(name, base), Robot)
    if machine.joint_names != robot.joint_names:
        raise ConfigError(
            f"{rig.name}: machine {name} has the joints {', '.join(machine.joint_names)}, but {robot.name} has"
            f" {', '.join(robot.joint_names)}. Name a machine with the same joints in the same order."
        )
    if not machine.effect and not rig.emulated.effect:
        return machine
    found = check_effects([*machine.effect, *rig.emulated.effect], machine, rig.name)
    return msgspec.structs.replace(machine, effect=found)


def _locate(name: str, base: Path | None) -> Path:
    for candidate in (Path(name), (base or Path()) / name):
        if candidate.is_file():
            return candidate
    shipped = Path(str(resources.files("emulator") / SHIPPED))
    stem = name.removesuffix(".toml")
    if (shipped / f"{stem}.toml").is_file():
        return shipped / f"{stem}.toml"
    known = ", ".join(sorted(path.stem for path in shipped.glob("*.toml")))
    raise ConfigError(f"machine {name}: no such file, and not one of the shipped {known}.")
