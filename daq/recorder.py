"""The recorder: frames, cell samples and events in, one recording and its verdict out.

A pure object apart from the file: time comes with the data, the outer loop owns clock, threads and buses. Replaying
the same input gives the same recording, byte for byte.
"""

import hashlib
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from daq.decode import Decoder
from daq.integrity import Integrity
from daq.rows import CycleRows, FrameRows, cell_values, event_values
from daq.store import Store
from protocols import config, topics
from protocols.frames import Frame
from protocols.rig import Rig
from protocols.robot import Robot
from protocols.topics import CellSample, Event

_BLOCK = 2048  # frames encoded at a time: numpy's overhead per call is spread over them
_COUNTERS_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Summary:
    """What was recorded.

    Attributes:
        path: The recording; the `.part` file where the disk refused.
        seconds: From the first to the last frame.
        frames, cycles: Counts.
        verdict, because: See `daq.integrity.Verdict`.
        counts: Messages by topic.
        queue_high_water: Most frames that ever waited for the writer.
        failure: Why the file is not complete; None if it is.
    """

    path: Path
    seconds: float
    frames: int
    cycles: int
    verdict: str
    because: tuple[str, ...]
    counts: Mapping[str, int]
    queue_high_water: int
    failure: str | None


class Recorder:
    """Writes one recording of a rig. Not thread safe.

    A disk that refuses ends the file, not the run: decoding and counting go on, and the summary says so.
    """

    def __init__(
        self,
        path: Path,
        rig: Rig,
        robot: Robot,
        eds: Mapping[str, str] | None = None,
        *,
        created_utc_ns: int = 0,
        seed: int | None = None,
    ) -> None:
        """Create the file.

        Args:
            robot: Nominal robot, as an acquisition system knows it.
            eds: Text of electronic data sheets by file name (`joint1.eds`).
            created_utc_ns: Date of the run [ns since 1970].
            seed: Of everything random, where the rig is emulated.

        Raises:
            DataError: The file cannot be created.
        """
        files = {topics.ROBOT_FILE: config.to_toml(robot), topics.RIG_FILE: config.to_toml(rig.for_recording())}
        files |= eds or {}
        start = run_start(rig, robot, files, created_utc_ns, seed)
        buses = [b.name for b in rig.bus]
        self._store = Store(path, start, buses, rig.recorder.chunk_bytes)
        for name, text in files.items():
            self._store.attach(name, topics.TOML_TYPE if name.endswith(".toml") else topics.EDS_TYPE, text)
        self.integrity = Integrity.of(buses, robot.joint_names)
        self._decoder = Decoder(rig, robot, self.integrity)
        self._frame_rows = {bus: FrameRows(bus) for bus in buses}
        self._cycle_rows = CycleRows(robot, rig.sync_period_us * 1000)
        self._waiting: dict[str, list[tuple[int, Frame]]] = {bus: [] for bus in buses}
        self._waiting_count = 0
        self._flush_ns = rig.recorder.flush_ms * 1_000_000
        self._next_flush_ns = self._flush_ns
        self._next_counters_ns = _COUNTERS_NS
        self._first_ns: int | None = None
        self._last_ns = 0
        self._cycles = 0
        self._summary: Summary | None = None

    def frames(self, bus: str, batch: Sequence[tuple[int, Frame]]) -> None:
        """Frames of one bus, pairs (arrival, frame); batches of all buses in the order of arrival.

        A batch should span a few cycles at most, so that the buses stay in step.
        """
        if not batch:
            return
        self._decoder.feed(bus, batch)
        self._waiting[bus] += batch
        self._waiting_count += len(batch)
        if self._first_ns is None:
            self._first_ns = batch[0][0]
            self._next_flush_ns = self._first_ns + self._flush_ns
            self._next_counters_ns = self._first_ns + _COUNTERS_NS
        if self._waiting_count >= _BLOCK:
            self._write()
        self.tick(batch[-1][0])

    def cell(self, sample: CellSample) -> None:
        """A poll of the cell."""
        self._store.write_one(topics.CELL, sample.t_ns, cell_values(sample))

    def event(self, event: Event) -> None:
        """Something that the buses do not tell."""
        self._store.write_one(topics.EVENTS, event.t_ns, event_values(event))

    def dropped(self, bus: str, total: int) -> None:
        """Frames that the socket or a full queue has dropped on a bus so far."""
        self.integrity.bus[bus].dropped = total

    def queued(self, frames: int) -> None:
        """Frames that wait for the writer at this moment."""
        self.integrity.queue_high_water = max(self.integrity.queue_high_water, frames)

    def tick(self, t_ns: int) -> None:
        """Time passes: flush and report when it is due. Needed where no frames arrive."""
        self._last_ns = max(self._last_ns, t_ns)
        if t_ns >= self._next_counters_ns:
            self._next_counters_ns = t_ns + _COUNTERS_NS
            self._report(t_ns)
        if t_ns >= self._next_flush_ns:
            self._next_flush_ns = t_ns + self._flush_ns
            self._write()
            self._store.flush()

    def sync(self) -> None:
        """Wait until the disk has what was flushed; seen to take more than a second."""
        self._store.sync()

    def close(self) -> Summary:
        """Complete the recording; calling it again changes nothing."""
        if self._summary is None:
            self._decoder.finish()
            self._write()
            self._report(self._last_ns)
            verdict = self.integrity.verdict()
            seconds = 0.0 if self._first_ns is None else (self._last_ns - self._first_ns) * 1e-9
            frames = sum(b.frames for b in self.integrity.bus.values())
            counts = self._store.counts
            stop = {
                "verdict": verdict.text,
                "because": "; ".join(verdict.because),
                "seconds": f"{seconds:.6f}",
                "frames": str(frames),
                "cycles": str(self._cycles),
                "queue_high_water": str(self.integrity.queue_high_water),
            }
            self._store.finish(stop | {f"count:{topic}": str(n) for topic, n in counts.items()})
            failure = self._store.failure
            self._summary = Summary(
                path=self._store.part if failure else self._store.path,
                seconds=seconds,
                frames=frames,
                cycles=self._cycles,
                verdict=verdict.text,
                because=verdict.because,
                counts=counts,
                queue_high_water=self.integrity.queue_high_water,
                failure=failure,
            )
        return self._summary

    def _report(self, t_ns: int) -> None:
        self._store.write_one(topics.COUNTERS, t_ns, self.integrity.message(t_ns))

    def _write(self) -> None:
        """Encode what waits."""
        for event in self._decoder.take_events():
            self.event(event)
        cycles = self._decoder.take_cycles()
        if cycles:
            self._cycles += len(cycles)
            arrival, grid, raw, states = self._cycle_rows(cycles)
            self._store.write(topics.CYCLE, arrival, grid, raw)
            self._store.write(topics.JOINTS, arrival, grid, states)
        for bus, batch in self._waiting.items():
            if batch:
                t_ns, rows = self._frame_rows[bus](batch)
                self._store.write(topics.FRAMES.format(bus=bus), t_ns, t_ns, rows)
        self._waiting = {bus: [] for bus in self._waiting}
        self._waiting_count = 0


def run_start(rig: Rig, robot: Robot, files: Mapping[str, str], utc_ns: int, seed: int | None) -> topics.RunStart:
    """What is known before the first frame."""
    return topics.RunStart(
        created_utc=datetime.fromtimestamp(utc_ns // 1_000_000_000, UTC).isoformat(),
        seed="" if seed is None else str(seed),
        armrig=version("armrig"),
        python=platform.python_version(),
        robot=robot.name,
        rig=rig.name,
        joints=" ".join(robot.joint_names),
        sync_period_us=str(rig.sync_period_us),
        sha256={name: hashlib.sha256(text.encode()).hexdigest() for name, text in files.items()},
    )
