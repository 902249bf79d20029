"""Frames and cycles to the CDR messages of their topics, many at a time."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.cycles import Cycle
from protocols import topics
from protocols.cdr import Block
from protocols.frames import ERROR, EXTENDED, ID_MASK, MAX_DATA, REMOTE, Frame
from protocols.robot import Robot
from protocols.signals import joint_side
from protocols.topics import CellSample, Event

_SECOND = np.uint64(1_000_000_000)
Times = NDArray[np.uint64]
Rows = NDArray[np.void]


class FrameRows:
    """Frames of one bus to `can_msgs/msg/Frame`."""

    def __init__(self, bus: str) -> None:
        zeros = dict.fromkeys(("id", "is_rtr", "is_extended", "is_error", "dlc"), 0)
        empty = {**topics.stamp(0), "header.frame_id": bus, **zeros, "data": bytes(MAX_DATA)}
        self._block = Block(topics.FRAME, topics.FRAME.encode(empty))

    def __call__(self, batch: Sequence[tuple[int, Frame]]) -> tuple[Times, Rows]:
        """Arrival times and messages of pairs (arrival, frame)."""
        times, frames = zip(*batch, strict=True)
        t_ns = np.array(times, dtype=np.uint64)
        can_id = np.array([f.can_id for f in frames], dtype=np.uint32)
        rows = self._block.rows(len(batch))
        _stamp(rows, t_ns)
        rows["id"] = can_id & ID_MASK
        rows["is_rtr"] = can_id & REMOTE
        rows["is_extended"] = can_id & EXTENDED
        rows["is_error"] = can_id & ERROR
        rows["dlc"] = [f.dlc or len(f.data) for f in frames]
        padded = b"".join([f.data.ljust(MAX_DATA, b"\0") for f in frames])
        rows["data"] = np.frombuffer(padded, dtype=np.uint8).reshape(-1, MAX_DATA)
        return t_ns, rows


class CycleRows:
    """Cycles to `armrig_msgs/msg/DriveCycle` and `sensor_msgs/msg/JointState`."""

    def __init__(self, robot: Robot, period_ns: int) -> None:
        names, n = robot.joint_names, robot.joints
        arrays = dict.fromkeys(("position_counts", "current_permille", "counter", "missing"), [0] * n)
        raw = {**topics.stamp(0), "header.frame_id": " ".join(names), "cycle": 0, **arrays}
        self._raw = Block(topics.DRIVE_CYCLE, topics.DRIVE_CYCLE.encode(raw))
        zeros = [0.0] * n
        state = {
            **topics.stamp(0),
            "header.frame_id": "",
            "name": names,
            "position": zeros,
            "velocity": [],
            "effort": zeros,
        }
        self._state = Block(topics.JOINT_STATE, topics.JOINT_STATE.encode(state))
        self._robot = robot
        self._period_ns = np.uint64(period_ns)

    def __call__(self, cycles: Sequence[Cycle]) -> tuple[Times, Times, Rows, Rows]:
        """Arrival times, grid times, raw messages and joint states."""
        index, arrival, position, current, counter, missing = (np.array(c) for c in zip(*cycles, strict=True))
        grid = index.astype(np.uint64) * self._period_ns
        raw = self._raw.rows(len(cycles))
        _stamp(raw, grid)
        raw["cycle"], raw["position_counts"], raw["current_permille"] = index, position, current
        raw["counter"], raw["missing"] = counter, missing

        states = self._state.rows(len(cycles))
        _stamp(states, grid)
        states["position"], states["effort"] = joint_side(self._robot, position, current, missing)
        return arrival.astype(np.uint64), grid, raw, states


def cell_values(sample: CellSample) -> Mapping[str, Any]:
    """Fields of an `armrig_msgs/msg/CellIo`."""
    fields = {name.lower(): value for name, value in sample._asdict().items()}
    return {**fields, **topics.stamp(sample.t_ns), "header.frame_id": "cell"}


def event_values(event: Event) -> Mapping[str, Any]:
    """Fields of an `rcl_interfaces/msg/Log`."""
    return {
        "stamp.sec": event.t_ns // 1_000_000_000,
        "stamp.nanosec": event.t_ns % 1_000_000_000,
        "level": event.level,
        "name": event.source,
        "msg": event.text,
        "file": "",
        "function": "",
        "line": 0,
    }


def _stamp(rows: Rows, t_ns: Times) -> None:
    rows["header.stamp.sec"] = t_ns // _SECOND
    rows["header.stamp.nanosec"] = t_ns % _SECOND
