"""The acquisition daemon's outer loops: the only places in `daq` that wait.

Reception runs in the calling thread and writing in its own, so that a slow disk never delays the sockets.
"""

import queue
import threading
from collections.abc import Callable, Sequence
from typing import BinaryIO

from daq.bus import Listener, wait_any
from daq.recorder import Recorder, Summary
from protocols.candump import parse_line
from protocols.clock import Clock
from protocols.errors import ConfigError, PeerError
from protocols.frames import Frame
from protocols.nmt import SYNC
from protocols.topics import ERROR_LEVEL, CellSample, Event

WAIT_S = 0.05
DISK_NS = 1_000_000_000  # how often the disk is asked to have everything, in case the power goes
PIPE_BYTES = 4096  # of text at a time: about seven cycles, so that the buses stay in step

Batch = tuple[int, list[tuple[int, Frame]]]  # bus index, (arrival, frame) pairs


class Writer(threading.Thread):
    """Feeds a recorder from a queue and owns it from start to finish."""

    def __init__(self, recorder: Recorder, buses: Sequence[str]) -> None:
        super().__init__(name="armrig-writer")
        self._recorder, self._buses = recorder, buses
        self._queue: queue.SimpleQueue[Batch | CellSample | Event | int | None] = queue.SimpleQueue()
        self._received = self._written = 0
        self._next_sync_ns = DISK_NS
        self.summary: Summary | None = None
        self.error: BaseException | None = None

    def put(self, item: CellSample | Event | int) -> None:
        """A poll of the cell, an event, or the time [ns] when nothing else has come."""
        self._queue.put(item)

    def frames(self, batch: Batch) -> None:
        """Frames of one bus."""
        self._received += len(batch[1])
        self._queue.put(batch)

    def finish(self) -> Summary:
        """Write what waits and complete the recording.

        Raises:
            BaseException: What ended the writer early; a defect, since a refusing disk is part of the summary.
        """
        self._queue.put(None)
        self.join()
        if self.error is not None:
            raise self.error
        if self.summary is None:
            raise RuntimeError("the writer ended without a summary")
        return self.summary

    def run(self) -> None:
        try:
            while (item := self._queue.get()) is not None:
                self._write(item)
            self.summary = self._recorder.close()
        except BaseException as error:  # noqa: BLE001 - handed to the thread that calls finish()
            self.error = error

    def _write(self, item: Batch | CellSample | Event | int) -> None:
        recorder = self._recorder
        if isinstance(item, CellSample):
            recorder.cell(item)
        elif isinstance(item, Event):
            recorder.event(item)
        elif isinstance(item, int):
            recorder.tick(item)
            if item >= self._next_sync_ns:
                self._next_sync_ns = item + DISK_NS
                recorder.sync()
        else:
            bus, frames = item
            recorder.queued(self._received - self._written)
            recorder.frames(self._buses[bus], frames)
            self._written += len(frames)


class Quiet:
    """Notices that the motion is over: SYNC has been there and has stopped."""

    def __init__(self, quiet_s: float | None) -> None:
        self._quiet_ns = None if quiet_s is None else int(quiet_s * 1e9)
        self._last_ns: int | None = None

    def over(self, t_ns: int, frames: Sequence[tuple[int, Frame]]) -> bool:
        """Whether SYNC has been missing for the time given.

        Args:
            t_ns: Now.
            frames: What has arrived since the last call.
        """
        if self._quiet_ns is None:
            return False
        if any(f.can_id == SYNC for _, f in frames):
            self._last_ns = t_ns
        return self._last_ns is not None and t_ns - self._last_ns > self._quiet_ns


def record(
    writer: Writer,
    listeners: Sequence[Listener],
    clock: Clock,
    stop: threading.Event,
    duration_s: float | None = None,
    quiet: Quiet | None = None,
) -> None:
    """Receive until stopped, for a time, or until the motion is over.

    A bus that goes away is an event in the recording, and the end of it.
    """
    end_ns = None if duration_s is None else int(duration_s * 1e9)
    quiet = quiet or Quiet(None)
    while not stop.is_set():
        try:
            batches = wait_any(listeners, WAIT_S)
        except PeerError as error:
            writer.put(Event(clock.now_ns(), ERROR_LEVEL, "daq", f"{error} The recording ends here."))
            return
        t_ns = clock.now_ns()
        over = False
        for bus, frames in enumerate(batches):
            if frames:
                writer.frames((bus, frames))
            over |= quiet.over(t_ns, frames)
        writer.put(t_ns)
        if over or (end_ns is not None and t_ns >= end_ns):
            return


def record_pipe(writer: Writer, stream: BinaryIO, buses: Sequence[str], stop: Callable[[], bool]) -> None:
    """Receive candump text, with the stamps it carries, until its end.

    Raises:
        DataError: A line that is no frame.
        ConfigError: A bus that the rig does not have.
    """
    index = {name: k for k, name in enumerate(buses)}
    while not stop() and (lines := stream.readlines(PIPE_BYTES)):
        batches: list[list[tuple[int, Frame]]] = [[] for _ in buses]
        for line in lines:
            t_ns, bus, frame = parse_line(line.decode("ascii", "replace"))
            if bus not in index:
                raise ConfigError(f"the pipe carries bus {bus}, but the rig has {', '.join(buses)}.")
            batches[index[bus]].append((t_ns, frame))
        for k, frames in enumerate(batches):
            if frames:
                writer.frames((k, frames))
