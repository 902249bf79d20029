"""Two or more robot files against one recording: which predicts torques better, which moves like the arm."""

from collections.abc import Sequence
from pathlib import Path

import msgspec
from rich.console import Console
from rich.table import Table

from ident import contract
from ident.base import base_parameters
from ident.dataset import prepare
from ident.identify import DEFAULTS, Settings
from ident.model import Model
from ident.observation import observe, relative_error
from ident.problem import Problem
from ident.recorded import signals
from ident.simulation import closed_loop
from protocols.errors import ArmrigError, ConfigError
from protocols.recording import read_recording
from protocols.robot import Robot


class Judged(msgspec.Struct, frozen=True):
    """One robot file.

    Attributes:
        torque: Of the inverse model along the measured motion.
        simulation: Closed loop; None where notes say why.
        parameters: Base parameters by name.
    """

    name: str
    robot: str
    torque: contract.Fit
    simulation: contract.Simulation | None
    parameters: dict[str, float]
    notes: list[str]


class Comparison(msgspec.Struct, frozen=True):
    """What `armrig compare --json` prints.

    Attributes:
        joints: Names, in the order of all lists.
        robots: In the order given.
        better: Name of the robot file with the smallest torque error, and per joint.
    """

    run: str
    joints: list[str]
    robots: list[Judged]
    better: str
    better_per_joint: list[str]


def compare(
    run: Path | bytes, robots: Sequence[tuple[str, Robot]], settings: Settings = DEFAULTS, name: str | None = None
) -> Comparison:
    """Judge robot files by a recording that none of them needs to have been identified from.

    Every robot reads the recording with its own drive gains, gears and offsets, so those are judged too.

    Args:
        robots: Pairs of name and robot, at least two.
        name: What messages call the recording.

    Raises:
        ConfigError: Fewer than two robots, or two of one name.
        DataError: As `read_recording` and `prepare`.
    """
    names = [label for label, _ in robots]
    if len(robots) < 2 or len(set(names)) < len(names):
        raise ConfigError(f"Comparing needs two robot files of different names, not {', '.join(names) or 'none'}.")
    judged = [_judge(run, label, robot, settings, name) for label, robot in robots]
    joints = robots[0][1].joint_names
    best = min(judged, key=lambda j: j.torque.relative_error_percent)
    per_joint = [
        min(judged, key=lambda j: float("inf") if (e := j.torque.per_joint_percent[k]) is None else e).name
        for k in range(len(joints))
    ]
    source = name or (str(run) if isinstance(run, Path) else "The recording")
    return Comparison(source, joints, judged, best.name, per_joint)


def to_json(comparison: Comparison) -> bytes:
    """Ends with a newline."""
    return msgspec.json.format(msgspec.json.encode(comparison), indent=2) + b"\n"


def show(comparison: Comparison, console: Console | None = None) -> None:
    """Print errors per joint, one column per robot file."""
    console = console or Console(highlight=False)
    simulated = [r.simulation for r in comparison.robots]
    nothing: list[float | None] = [None] * len(comparison.joints)
    for title, errors in (
        ("torque error of the inverse model, %", [r.torque.per_joint_percent for r in comparison.robots]),
        ("torque error in closed loop, %", [s.torque_error_percent if s else nothing for s in simulated]),
        ("position error in closed loop, %", [s.position_error_percent if s else nothing for s in simulated]),
    ):
        table = Table(box=None, pad_edge=False, header_style="bold")
        table.add_column(title)
        for robot in comparison.robots:
            table.add_column(robot.name, justify="right")
        for joint, *values in zip(comparison.joints, *errors, strict=True):
            table.add_row(joint, *("-" if value is None else f"{value:.3f}" for value in values))
        console.print(table)
    for robot in comparison.robots:
        console.print(f"{robot.name}: torque error {robot.torque.relative_error_percent:.2f} % on {comparison.run}")
        for note in robot.notes:
            console.print(f"  {note}")
    console.print(f"{comparison.better} predicts the torques better.")


def _judge(run: Path | bytes, label: str, robot: Robot, settings: Settings, name: str | None) -> Judged:
    model = Model.of(robot, offsets=settings.offsets)
    base = base_parameters(model)
    measured = signals(read_recording(run, robot, name))
    dataset = prepare(measured, settings.filter_Hz)
    rows = observe(dataset, model, base, settings.decimate_to_Hz, settings.speed_threshold_rad_s)
    theta = model.theta(robot)
    beta = base.B @ theta
    total, per_joint = relative_error([rows], beta)
    problem = Problem(
        model, base, [measured], [dataset], [rows], settings.decimate_to_Hz, settings.speed_threshold_rad_s
    )
    simulation, notes = None, list(rows.notes)
    try:
        simulation = closed_loop(problem, theta)
    except ArmrigError as error:
        notes.append(f"No closed-loop simulation. {error}")
    return Judged(
        name=label,
        robot=robot.name,
        torque=contract.Fit(total, [contract.finite(e) for e in per_joint], rows.bandwidth_Hz, rows.rows),
        simulation=simulation,
        parameters=dict(zip(base.names, beta.tolist(), strict=True)),
        notes=notes,
    )
