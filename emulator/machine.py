"""The emulated truth of a rig: the robot file that says how the machine really is. Never leaves the emulator."""

from importlib import resources
from pathlib import Path

from protocols import config
from protocols.effects import Effect
from protocols.errors import ConfigError
from protocols.rig import Rig
from protocols.robot import Robot

SHIPPED = "machines"  # package folder with the machines that come with armrig
EMULATED_EFFECTS: tuple[Effect, ...] = ()  # beyond rigid bodies, rotors, viscous and Coulomb friction, offsets


def load_machine(rig: Rig, robot: Robot, base: Path | None = None) -> Robot:
    """The machine of a rig.

    Args:
        robot: The rig's nominal robot, which the machine is where the rig names no other.
        base: Folder of the rig file, where a relative path starts.

    Raises:
        ConfigError: No such machine; a file that is no robot; other joints than the nominal robot's; physics that
            the emulator cannot simulate.
    """
    name = rig.emulated.machine
    machine = robot if name is None else config.read(_locate(name, base), Robot)
    if machine.joint_names != robot.joint_names:
        raise ConfigError(
            f"{rig.name}: machine {name} has the joints {', '.join(machine.joint_names)}, but {robot.name} has"
            f" {', '.join(robot.joint_names)}. Name a machine with the same joints in the same order."
        )
    for entry in (*machine.effect, *rig.emulated.effect):
        if entry.effect not in EMULATED_EFFECTS:
            raise ConfigError(
                f"{rig.name}: effect {entry.effect}{'@' * bool(entry.joint)}{entry.joint} cannot be emulated."
                " Remove it from the machine and the rig."
            )
    return machine


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
