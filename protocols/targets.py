"""What the host asked of the drives: the targets in RPDO2, from the raw frames of a recording.

They are the reference trajectory of an identification by simulation. Read when asked for only: there are several times
as many raw frames as cycles.
"""

import itertools
from typing import NamedTuple

import numpy as np

from protocols import nmt, topics
from protocols.cdr import Block, MessageType
from protocols.container import Contents
from protocols.errors import DataError
from protocols.gather import Messages, messages
from protocols.pdo import Mapped
from protocols.recording import Recording
from protocols.signals import Floats, Ints

TARGET_TORQUE, TARGET_POSITION = 0x6071, 0x607A
PAUSE_NS = 500_000_000  # without SYNC for so long the host has stopped: indices are found anew


class Targets(NamedTuple):
    """Targets that became active at the SYNC of each row, held by the drives until the next.

    Attributes:
        position_counts: 0x607A, shape (T, J); NaN before the first.
        torque_permille: 0x6071, shape (T, J); NaN before the first, or where it is not mapped.
    """

    position_counts: Floats
    torque_permille: Floats

    @property
    def by_position(self) -> bool:
        """The drives control position (CSP): the host streams no torque."""
        return not np.nan_to_num(self.torque_permille).any()


def read_targets(recording: Recording) -> Targets:
    """Targets on the rows of a recording.

    Raises:
        DataError: A foreign recording, no frames of a bus, or no target of a drive among them; says what to do.
    """
    rig, contents, label = recording.rig, recording.contents, recording.source
    if rig is None or recording.drives is None:
        raise DataError(
            f"{label}: holds no CAN frames, so the reference trajectory is not known. Methods that simulate need a"
            " recording made by armrig record while the host streams its targets; ols and wls do not."
        )
    mapped = [Mapped.parse(entry) for entry in rig.pdo.target]
    if TARGET_POSITION not in [m.index for m in mapped]:
        raise DataError(
            f"{label}: the target PDOs carry no target position (607A:0/32), so the reference trajectory is not known."
            " Add it to pdo.target of the rig file and record again."
        )
    topic = {bus.name: topics.FRAMES.format(bus=bus.name) for bus in rig.bus}
    found = messages(contents, [topics.CYCLE, *topic.values()])
    arrival = np.array(found[topics.CYCLE].log_time, dtype=np.int64)
    shape = recording.position_rad.shape
    targets = {TARGET_POSITION: np.full(shape, np.nan), TARGET_TORQUE: np.full(shape, np.nan)}
    nodes = {d.joint: d for d in rig.drive}
    frames = {bus: _Frames(contents, name, found[name], label) for bus, name in topic.items()}
    indices = {bus: f.sync_cycles(recording.cycle, arrival, rig.sync_overflow) for bus, f in frames.items()}
    for j, joint in enumerate(recording.robot.joint_names):
        drive = nodes[joint]
        cycle, data = frames[drive.bus].before_sync(nmt.rpdo_id(2, drive.node), *indices[drive.bus])
        if not cycle.size:
            raise DataError(
                f"{label}: no RPDO2 of {joint} (node {drive.node}) is among the frames of {drive.bus}, so its reference"
                " trajectory is not known. Let the recorder run while the host does."
            )
        held = np.searchsorted(cycle, recording.cycle, side="right") - 1
        start = 0
        for entry in mapped:
            if entry.index in targets:
                raw = np.ascontiguousarray(data[:, start : start + entry.bits // 8]).view(f"<i{entry.bits // 8}")[:, 0]
                targets[entry.index][:, j] = np.where(held >= 0, raw[held], np.nan)
            start += entry.bits // 8
    return Targets(targets[TARGET_POSITION], targets[TARGET_TORQUE])


class _Frames:
    """Frames of one bus, in order."""

    def __init__(self, contents: Contents, topic: str, found: Messages, label: str) -> None:
        if not found.blocks:
            raise DataError(f"{label}: has no frames on {topic}, so the reference trajectory is not known.")
        channel = next(c for c in contents.channels.values() if c.topic == topic)
        schema = contents.schemas[channel.schema_id]
        kind = MessageType.parse(schema.name, schema.data.decode(errors="replace"))
        parts = [Block(kind, block[0].tobytes()).view(block) for block in found.blocks]
        self._id = np.concatenate([p["id"] for p in parts])
        self._dlc = np.concatenate([p["dlc"] for p in parts])
        self._data = np.concatenate([p["data"] for p in parts])
        self._t_ns = np.array(found.log_time, dtype=np.int64)

    def sync_cycles(self, cycle: Ints, arrival: Ints, overflow: int) -> tuple[Ints, Ints]:
        """Place among the frames and cycle of every SYNC.

        The SYNC counter gives the steps, lost SYNCs included; that the recorder stamped each cycle with the arrival of
        its SYNC gives the start, as the median over a stretch, so that no single late frame decides.

        Args:
            cycle, arrival: Of the rows of the recording.
        """
        place = np.flatnonzero(self._id == nmt.SYNC)
        if not place.size:
            return place, place
        counted = self._dlc[place] > 0
        step = np.diff(self._data[place, 0].astype(np.int64)) % overflow
        step[~(counted[1:] & counted[:-1])] = 1
        place, step = place[np.append(True, step > 0)], step[step > 0]
        t_ns = self._t_ns[place]
        out = np.concatenate([[0], np.cumsum(step)])
        bounds = [0, *(np.flatnonzero(np.diff(t_ns) > PAUSE_NS) + 1), len(place)]
        for start, end in itertools.pairwise(bounds):
            rows = (arrival >= t_ns[start]) & (arrival <= t_ns[end - 1])
            rows = rows if rows.any() else np.ones(len(cycle), dtype=bool)
            after = np.clip(
                np.searchsorted(t_ns[start:end], arrival[rows]), 1 if end - start > 1 else 0, end - start - 1
            )
            before = np.maximum(after - 1, 0)
            near = t_ns[start + after] - arrival[rows] < arrival[rows] - t_ns[start + before]
            nearest = out[start + np.where(near, after, before)]
            out[start:end] += int(np.median(cycle[rows] - nearest))
        return place, out

    def before_sync(self, can_id: int, place: Ints, cycle: Ints) -> tuple[Ints, Ints]:
        """The last frame of an identifier before each SYNC: cycle at which it became active, and its eight bytes."""
        frame = np.flatnonzero(self._id == can_id)
        sync = np.searchsorted(place, frame)
        frame, sync = frame[sync < len(place)], sync[sync < len(place)]
        last = np.append(np.diff(sync) > 0, True)[: len(sync)]
        return cycle[sync[last]], self._data[frame[last]]
