"""The acquisition daemon's outer loops: the only places in `daq` that wait.

Reception runs in the calling thread and writing in its own, so that a slow disk never delays the sockets.
"""

import queue
import threading
from collections.abc import Callable, Sequence
from typing import BinaryIO, NamedTuple

from daq.bus import Listener, wait_any
from daq.recorder import Recorder, Summary
from protocols.candump import parse_line
from protocols.clock import Clock
from protocols.errors import ConfigError, PeerError
from protocols.frames import Frame
from protocols.nmt import SYNC
from protocols.topics import ERROR_LEVEL, INFO, WARNING, CellSample, Event

WAIT_S = 0.05
DISK_NS = 1_000_000_000  # how often the disk is asked to have everything, in case the power goes
PIPE_BYTES = 4096  # of text at a time: about seven cycles, so that the buses stay in step

DROPS_NS = 1_000_000_000  # how often losses are asked for that no frame has told of

Batch = tuple[int, list[tuple[int, Frame]]]  # bus index, (arrival, frame) pairs


class Drops(NamedTuple):
    """Frames that a listener of ours has lost so far."""

    bus: str
    total: int


class Writer(threading.Thread):
    """Feeds a recorder from a queue and owns it from start to finish."""

    def __init__(self, recorder: Recorder, buses: Sequence[str]) -> None:
        super().__init__(name="armrig-writer")
        self._recorder, self._buses = recorder, buses
        self._queue: queue.SimpleQueue[Batch | CellSample | Event | Drops | int | None] = queue.SimpleQueue()
        self._received = self._written = 0
        self._next_sync_ns = DISK_NS
        self.summary: Summary | None = None
        self.error: BaseException | None = None

    def put(self, item: CellSample | Event | Drops | int) -> None:
        """A poll of the cell, an event, losses, or the time [ns] when nothing else has come."""
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

    def _write(self, item: Batch | CellSample | Event | Drops | int) -> None:
        recorder = self._recorder
        if isinstance(item, CellSample):
            recorder.cell(item)
        elif isinstance(item, Event):
            recorder.event(item)
        elif isinstance(item, Drops):
            recorder.dropped(item.bus, item.total)
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


class Watch:
    """Tells the recorder what the listeners lose and what happens to them."""

    def __init__(self, listeners: Sequence[Listener], writer: Writer) -> None:
        self._listeners, self._writer = listeners, writer
        self._told = [0] * len(listeners)
        self._next_ns = 0

    def begin(self, t_ns: int) -> None:
        """Say where the stamps come from."""
        for listener in self._listeners:
            self._writer.put(Event(t_ns, INFO, listener.name, listener.stamps))

    def look(self, t_ns: int, *, now: bool = False) -> None:
        """Pass on what is new; the kernel is asked for drops once a second, or `now`."""
        due = now or t_ns >= self._next_ns
        if due:
            self._next_ns = t_ns + DROPS_NS
        for k, listener in enumerate(self._listeners):
            for text in listener.take_remarks():
                self._writer.put(Event(t_ns, WARNING, listener.name, text))
            total = listener.count_drops() if due else self._told[k]
            if total > self._told[k]:
                text = f"{total - self._told[k]} frames were lost between kernel and recorder: it was too slow"
                self._writer.put(Event(t_ns, ERROR_LEVEL, listener.name, text))
                self._writer.put(Drops(listener.name, total))
                self._told[k] = total


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
    watch = Watch(listeners, writer)
    watch.begin(clock.now_ns())
    try:
        _receive(writer, listeners, clock, stop, end_ns, quiet, watch)
    except PeerError as error:
        writer.put(Event(clock.now_ns(), ERROR_LEVEL, "daq", f"{error} The recording ends here."))
    finally:
        watch.look(clock.now_ns(), now=True)


def _receive(
    writer: Writer,
    listeners: Sequence[Listener],
    clock: Clock,
    stop: threading.Event,
    end_ns: int | None,
    quiet: Quiet,
    watch: Watch,
) -> None:
    while not stop.is_set():
        batches = wait_any(listeners, WAIT_S)
        t_ns = clock.now_ns()
        over = False
        for bus, frames in enumerate(batches):
            if frames:
                writer.frames((bus, frames))
            over |= quiet.over(t_ns, frames)
        watch.look(t_ns)
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
