"""Messages of a recording to arrays on one time grid: raw drive integers, foreign joint states, cell and events."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocols.cdr import Block, MessageType
from protocols.errors import DataError
from protocols.gather import Messages
from protocols.robot import Robot
from protocols.topics import Event

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]


class DriveSignals(NamedTuple):
    """What the drives sent.

    Attributes:
        position_counts: 0x6064, shape (T, J).
        current_permille: 0x6078, of the rated current, shape (T, J).
        counter: 0x2001, shape (T, J).
    """

    position_counts: Ints
    current_permille: Ints
    counter: Ints


@dataclass(frozen=True, slots=True)
class JointSignals:
    """Joint side on the time grid; `protocols.recording.Recording` describes the fields."""

    period_s: float
    t_s: Floats
    cycle: Ints
    position_rad: Floats
    effort_Nm: Floats
    missing: Flags
    drives: DriveSignals | None


class CellSignals(NamedTuple):
    """What the cell sent, at its own times.

    Attributes:
        t_s: Arrival, shape (S,).
        motor_temperature_C: shape (S, M).
        ambient_temperature_C, supply_V: shape (S,).
        emergency_stop, brake_released, stale: shape (S,).
    """

    t_s: Floats
    motor_temperature_C: Floats
    ambient_temperature_C: Floats
    supply_V: Floats
    emergency_stop: Flags
    brake_released: Flags
    stale: Flags


def joint_side(robot: Robot, counts: Ints, permille: Ints, missing: Flags) -> tuple[Floats, Floats]:
    """Joint positions [rad] and, from the robot's drive gains, joint torques [N·m], shapes (T, J).

    NaN where a drive that the value depends on was not heard: with coupled axes one drive speaks for two joints.
    """
    rated_A = np.array([j.drive.rated_current_A for j in robot.joint])
    coupling = robot.coupling_matrix()
    q = robot.joint_position(counts)
    tau = robot.joint_torque(permille * (rated_A / 1000))
    q[missing @ (np.linalg.inv(coupling).T != 0)] = np.nan
    tau[missing @ (coupling != 0)] = np.nan
    return q, tau


def of_drives(kind: MessageType, found: Messages, robot: Robot, period_s: float, label: str) -> JointSignals:
    """Joint side of `/drives/cycle`.

    Raises:
        DataError: Another robot's, or not in order.
        ValueError: The messages do not follow their type.
    """
    recorded = kind.decode(next(_each(found)))["header.frame_id"].split()
    if recorded != robot.joint_names:
        raise DataError(
            f"{label}: recorded are the joints {', '.join(recorded)}, but the robot {robot.name} has"
            f" {', '.join(robot.joint_names)}. Give the robot file of the recorded arm with --robot."
        )
    rows = _table(kind, found)
    cycle = rows["cycle"].astype(np.int64)
    if (np.diff(cycle) <= 0).any():
        row = int(np.argmax(np.diff(cycle) <= 0)) + 1
        raise DataError(f"{label}: cycle {cycle[row]} follows cycle {cycle[row - 1]}; the recording is not in order.")
    drives = DriveSignals(
        rows["position_counts"].astype(np.int64),
        rows["current_permille"].astype(np.int64),
        rows["counter"].astype(np.int64),
    )
    missing = rows["missing"].astype(bool)
    q, tau = joint_side(robot, drives.position_counts, drives.current_permille, missing)
    t_s = np.multiply(cycle, period_s, dtype=np.float64)
    return JointSignals(period_s, t_s, cycle, q, tau, missing, drives)


def of_joint_states(kind: MessageType, found: Messages, robot: Robot, label: str) -> JointSignals:
    """Joint side of a foreign `sensor_msgs/msg/JointState`, on the even grid nearest to its stamps.

    Raises:
        DataError: A joint or the efforts are missing, NaN, or stamps are not increasing.
        ValueError: The messages do not follow their type.
    """
    names = kind.decode(next(_each(found)))["name"]
    absent = [name for name in robot.joint_names if name not in names]
    if absent:
        raise DataError(
            f"{label}: has the joints {', '.join(names)}, but not {', '.join(absent)} of the robot {robot.name}."
            " Give the robot file of the recorded arm with --robot."
        )
    rows = _table(kind, found)
    order = [names.index(name) for name in robot.joint_names]
    values: dict[str, Floats] = {}
    for key in ("position", "effort"):
        if rows.dtype.names is None or key not in rows.dtype.names or rows[key].shape[1] != len(names):
            raise DataError(f"{label}: the joint states have no {key}; identification needs position and effort.")
        values[key] = rows[key][:, order].astype(float)
        bad = ~np.isfinite(values[key])
        if bad.any():
            row, joint = np.argwhere(bad)[0]
            raise DataError(
                f"{label}: {key} of {robot.joint_names[joint]} is {values[key][row, joint]} in row {row} of {len(rows)}"
                f" ({np.count_nonzero(bad)} such values). Cut these rows out or repair them, then import again."
            )
    t_ns = rows["header.stamp.sec"].astype(np.int64) * 1_000_000_000 + rows["header.stamp.nanosec"]
    if not t_ns.any():
        t_ns = np.array(found.log_time, dtype=np.int64)
    steps = np.diff(t_ns)
    if len(t_ns) < 2 or (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 1 if len(t_ns) > 1 else 0
        raise DataError(f"{label}: the time stamps do not increase (row {row} of {len(t_ns)}).")
    cycle = np.concatenate([[0], np.cumsum(np.maximum(1, np.rint(steps / np.median(steps))).astype(np.int64))])
    period_s = float(t_ns[-1] - t_ns[0]) * 1e-9 / float(cycle[-1])
    missing = np.zeros(values["position"].shape, dtype=bool)
    return JointSignals(period_s, cycle * period_s, cycle, values["position"], values["effort"], missing, None)


def of_cell(kind: MessageType, found: Messages) -> CellSignals | None:
    """Samples of `/cell/io`; None if there are none.

    Raises:
        ValueError: The messages do not follow their type.
    """
    if not found.blocks:
        return None
    rows = _table(kind, found)
    return CellSignals(
        t_s=rows["header.stamp.sec"] + rows["header.stamp.nanosec"] * 1e-9,
        motor_temperature_C=rows["motor_temperature_c"].astype(float),
        ambient_temperature_C=rows["ambient_temperature_c"].astype(float),
        supply_V=rows["supply_v"].astype(float),
        emergency_stop=rows["emergency_stop"].astype(bool),
        brake_released=rows["brake_released"].astype(bool),
        stale=rows["stale"].astype(bool),
    )


def of_events(kind: MessageType, found: Messages) -> tuple[Event, ...]:
    """Events of `/rig/events`.

    Raises:
        ValueError: The messages do not follow their type.
    """
    events = []
    for data in _each(found):
        values: Mapping[str, object] = kind.decode(data)
        t_ns = int(str(values["stamp.sec"])) * 1_000_000_000 + int(str(values["stamp.nanosec"]))
        events.append(Event(t_ns, int(str(values["level"])), str(values["name"]), str(values["msg"])))
    return tuple(events)


def _each(found: Messages) -> Iterator[bytes]:
    for block in found.blocks:
        for row in block:
            yield row.tobytes()


def _table(kind: MessageType, found: Messages) -> NDArray[np.void]:
    """All messages of one shape as rows."""
    sizes = {block.shape[1] for block in found.blocks}
    if len(sizes) > 1:
        raise ValueError(f"{kind.name}: messages have {len(sizes)} different sizes, from {min(sizes)} bytes on")
    return Block(kind, next(_each(found))).view(np.concatenate(found.blocks))
