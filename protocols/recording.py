"""A recording, read for identification: raw drive integers or foreign joint states on one time grid, checked.

Arrival times are not among the data: time is SYNC index times period. Gaps stay gaps.
"""

import hashlib
import mmap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np

from protocols import config, signals, topics
from protocols.cdr import MessageType
from protocols.container import BrokenFileError, Contents, scan
from protocols.errors import ConfigError, DataError
from protocols.gather import messages
from protocols.rig import Rig
from protocols.robot import Robot
from protocols.signals import CellSignals, DriveSignals, Flags, Floats, Ints
from protocols.topics import Event

T = TypeVar("T", bound=msgspec.Struct)


class Gap(NamedTuple):
    """Cycles that are not in the recording.

    Attributes:
        after_s: Time of the last cycle before.
        cycles: How many.
        joints: Whose.
    """

    after_s: float
    cycles: int
    joints: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Recording:
    """One recording. Arrays are read-only.

    Attributes:
        source: Name for messages.
        sha256: Of the file.
        robot: The one given, or the nominal one attached.
        rig: Attached; None in a foreign recording.
        period_s: Of the grid.
        t_s: Time of each row, cycle times period, shape (T,).
        cycle: SYNC index of each row, shape (T,); steps by more than one where rows are missing.
        position_rad: Joint side, shape (T, J); NaN where not known.
        effort_Nm: Joint side from the robot's drive gains, shape (T, J); NaN where not known. Foreign: as it says.
        missing: The drive was not heard in that cycle, shape (T, J).
        drives: Raw integers; None in a foreign recording.
        gaps: What is missing, in order of time.
        verdict: `LOSSLESS`, `GAPS(n)` or `UNVERIFIABLE`.
        metadata: Records by name.
        cell: None if nothing of a cell is recorded.
        events: In order of the file.
        contents: The scanned file, for what is read when asked for (`protocols.targets`).
    """

    source: str
    sha256: str
    robot: Robot
    rig: Rig | None
    period_s: float
    t_s: Floats
    cycle: Ints
    position_rad: Floats
    effort_Nm: Floats
    missing: Flags
    drives: DriveSignals | None
    gaps: tuple[Gap, ...]
    verdict: str
    metadata: Mapping[str, Mapping[str, str]]
    cell: CellSignals | None
    events: tuple[Event, ...]
    contents: Contents

    def current_A(self) -> Floats:
        """Drive currents, shape (T, J) [A]; NaN where not known.

        Raises:
            DataError: A foreign recording has efforts only.
        """
        if self.drives is None:
            raise DataError(f"{self.source}: has efforts, not currents.")
        rated_A = np.array([j.drive.rated_current_A for j in self.robot.joint])
        return np.where(self.missing, np.nan, self.drives.current_permille * (rated_A / 1000))

    def stretches(self, least: int = 1) -> list[slice]:
        """Rows without any gap between them, at least so many."""
        whole = ~np.asarray(self.missing.any(axis=1))
        joined = whole[1:] & whole[:-1] & (np.diff(self.cycle) == 1)
        starts = np.flatnonzero(np.concatenate([[True], ~joined]))
        ends = np.append(starts[1:], len(whole))
        return [slice(int(a), int(b)) for a, b in zip(starts, ends, strict=True) if whole[a] and b - a >= least]


def read_recording(source: Path | bytes, robot: Robot | None = None, name: str | None = None) -> Recording:
    """Recording of a file, or of its bytes.

    Args:
        robot: Replaces the attached robot.
        name: What messages call it; the path where left out.

    Raises:
        DataError: Unreadable, truncated, damaged, empty, NaN, or of another robot. Says what to do.
    """
    label = name or (str(source) if isinstance(source, Path) else "The recording")
    buffer = memoryview(source) if isinstance(source, bytes) else map_file(source, label)
    try:
        contents = scan(buffer)
        wanted = _wanted(contents, label)
        found = messages(contents, wanted)
    except BrokenFileError as error:
        raise damage(label, error) from error
    robot = robot or _attached(contents, topics.ROBOT_FILE, Robot, label)
    if robot is None:
        raise DataError(f"{label}: no robot file is attached. Give one with --robot.")
    rig = _attached(contents, topics.RIG_FILE, Rig, label)
    main = wanted[0]
    if not found[main].blocks:
        raise DataError(
            f"{label}: {main} is empty: no drive answered a SYNC while it was recorded. Start the motion host"
            " (armrig move) while the recorder runs."
        )
    try:
        kinds = _kinds(contents, wanted)
        if main == topics.CYCLE:
            period_s = _period_s(contents, rig, label)
            joints = signals.of_drives(kinds[main], found[main], robot, period_s, label)
        else:
            joints = signals.of_joint_states(kinds[main], found[main], robot, label)
        cell = signals.of_cell(kinds[topics.CELL], found[topics.CELL]) if topics.CELL in kinds else None
        events = signals.of_events(kinds[topics.EVENTS], found[topics.EVENTS]) if topics.EVENTS in kinds else ()
    except (ValueError, KeyError) as error:  # from the message codec; a KeyError names the field
        raise DataError(f"{label} does not follow its own message types: {error}.") from error
    for array in (joints.t_s, joints.cycle, joints.position_rad, joints.effort_Nm, joints.missing):
        array.setflags(write=False)
    return Recording(
        source=label,
        sha256=hashlib.sha256(buffer).hexdigest(),
        robot=robot,
        rig=rig,
        period_s=joints.period_s,
        t_s=joints.t_s,
        cycle=joints.cycle,
        position_rad=joints.position_rad,
        effort_Nm=joints.effort_Nm,
        missing=joints.missing,
        drives=joints.drives,
        gaps=_gaps(joints, robot.joint_names),
        verdict=verdict(contents),
        metadata=contents.metadata,
        cell=cell,
        events=events,
        contents=contents,
    )


def map_file(path: Path, label: str) -> memoryview:
    """Bytes of a file, paged in as they are read.

    Raises:
        DataError: It cannot be read, or is empty.
    """
    try:
        with path.open("rb") as file:
            if file.seek(0, 2) == 0:
                raise DataError(f"{label}: the file is empty.")
            return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except OSError as error:
        raise DataError(f"{label}: cannot be read: {error.strerror}.") from error


def damage(label: str, error: BrokenFileError) -> DataError:
    """What to tell of a file that is not whole."""
    if error.offset == 0:
        return DataError(f"{label} {error}. Recordings are made with armrig record or armrig import.")
    return DataError(f"{label} {error} (byte {error.offset}). Run armrig recover {label} -o FIXED.mcap and use that.")


def verdict(contents: Contents) -> str:
    """Verdict at the end of the run, or of its recovery."""
    stop = contents.metadata.get(topics.RECOVERED) or contents.metadata.get(topics.RUN_STOP) or {}
    return stop.get("verdict", "UNVERIFIABLE")


def _wanted(contents: Contents, label: str) -> list[str]:
    """Topics to read, the one with the joints first."""
    kinds = {
        c.topic: contents.schemas[c.schema_id].name
        for c in contents.channels.values()
        if c.schema_id in contents.schemas
    }
    others = [topic for topic in (topics.CELL, topics.EVENTS) if topic in kinds]
    if topics.CYCLE in kinds:
        return [topics.CYCLE, *others]
    states = sorted(topic for topic, kind in kinds.items() if kind == topics.JOINT_STATE.name)
    if not states:
        raise DataError(
            f"{label}: has neither {topics.CYCLE} nor a topic of type {topics.JOINT_STATE.name}, only"
            f" {', '.join(sorted(kinds)) or 'nothing'}. Recordings are made with armrig record or armrig import."
        )
    return [topics.JOINTS if topics.JOINTS in states else states[0], *others]


def _kinds(contents: Contents, wanted: list[str]) -> dict[str, MessageType]:
    """Types of the topics, by the file's own definitions.

    Raises:
        ValueError: Not CDR with ros2msg definitions.
    """
    kinds = {}
    for channel in contents.channels.values():
        if channel.topic in wanted:
            schema = contents.schemas[channel.schema_id]
            if (channel.message_encoding, schema.encoding) != (topics.ENCODING, topics.SCHEMA_ENCODING):
                raise ValueError(
                    f"{channel.topic} is encoded as {channel.message_encoding} by {schema.encoding};"
                    f" {topics.ENCODING} by {topics.SCHEMA_ENCODING} is read"
                )
            kinds[channel.topic] = MessageType.parse(schema.name, schema.data.decode(errors="replace"))
    return kinds


def _attached(contents: Contents, name: str, kind: type[T], label: str) -> T | None:
    data = contents.attachments.get(name)
    if data is None:
        return None
    try:
        return config.parse(data.decode(errors="replace"), kind, f"{label}, attached {name}")
    except ConfigError as error:
        raise DataError(str(error)) from error


def _period_s(contents: Contents, rig: Rig | None, label: str) -> float:
    if rig is not None:
        return rig.sync_period_us * 1e-6
    text = contents.metadata.get(topics.RUN_START, {}).get("sync_period_us", "")
    if not text.isdecimal() or int(text) == 0:
        raise DataError(f"{label}: the SYNC period is not recorded: neither a rig file nor RunStart has it.")
    return int(text) * 1e-6


def _gaps(joints: signals.JointSignals, names: list[str]) -> tuple[Gap, ...]:
    gaps = [
        Gap(float(joints.t_s[row]), int(joints.cycle[row + 1] - joints.cycle[row]) - 1, tuple(names))
        for row in np.flatnonzero(np.diff(joints.cycle) > 1)
    ]
    holes = np.asarray(joints.missing.any(axis=1))
    same = (joints.missing[1:] == joints.missing[:-1]).all(axis=1) & (np.diff(joints.cycle) == 1)
    starts = np.flatnonzero(holes & np.concatenate([[True], ~same]))
    ends = np.append(np.flatnonzero(~same) + 1, len(holes))
    for row in starts:
        rows = int(ends[np.searchsorted(ends, row, side="right")] - row)
        who = tuple(name for name, absent in zip(names, joints.missing[row], strict=True) if absent)
        gaps.append(Gap(float(joints.t_s[row] - joints.period_s), rows, who))
    return tuple(sorted(gaps))
