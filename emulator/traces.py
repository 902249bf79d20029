"""The recorder inside a drive: position and current up to every 200 us, faster than any PDO, fetched by SDO block.

Objects 0x2040 (set up and state) and 0x2041 (data: per sample position [counts] and current [mA], both INTEGER32).
A sample's position is of its instant, its current the mean since the sample before.
"""

import struct
from collections import deque
from collections.abc import Sequence

from emulator.axis import Axis, clamp32
from emulator.store import ObjectStore
from protocols.objects import Entry, Value, key
from protocols.sdo import Abort, SdoError

_RECORDER = 0x2040
_CONTROL, _STATE, _PERIOD, _SAMPLES = (key(_RECORDER, i) for i in (1, 2, 3, 4))
_TRIGGER, _LEVEL, _BEFORE, _COUNT, _CYCLE = (key(_RECORDER, i) for i in (5, 6, 7, 8, 9))
_DATA = 0x2041
_CYCLES = key(0x2001)

IDLE, ARMED, RECORDING, COMPLETE = range(4)  # of 0x2040:2
AT_ONCE, RISING, FALLING, CURRENT, ENABLED = range(5)  # of 0x2040:5

_SAMPLE = struct.Struct("<ii")


class TraceRecorder:
    """One drive's recorder.

    Args:
        grid_s: Spacing of the samples that `feed` brings; the sample period must be a multiple of it.

    Attributes:
        running: Samples are wanted.
    """

    def __init__(self, store: ObjectStore, axis: Axis, grid_s: float) -> None:
        self._axis = axis
        self._values = store.values
        self._grid_us = 1e6 * grid_s
        self._kept: deque[tuple[int, int]] = deque()
        self._phase = 0  # how much of the next sample is there
        self._sum_A = 0.0
        store.guard(_RECORDER, self._check, self._control)
        store.provide(_DATA, self.data)
        self.reset()

    def reset(self) -> None:
        self.running = False
        self._kept.clear()
        self._phase, self._sum_A = 0, 0.0
        self._last: tuple[int, int] | None = None

    def data(self) -> bytes:
        """Content of 0x2041."""
        return b"".join([_SAMPLE.pack(*sample) for sample in self._kept])

    def feed(self, counts: Sequence[int], current_A: Sequence[float], *, enabled: bool) -> None:
        """What happened in one period, on the grid.

        Args:
            enabled: The drive is in OPERATION_ENABLED.
        """
        values = self._values
        step = round(values[_PERIOD] / self._grid_us)
        for position, current in zip(counts, current_A, strict=True):
            self._sum_A += current
            self._phase += 1
            if self._phase == step:
                sample = clamp32(position - self._axis.zero), clamp32(1000 * self._sum_A / step)
                self._phase, self._sum_A = 0, 0.0
                self._take(sample, enabled=enabled)
                if not self.running:
                    return

    def _take(self, sample: tuple[int, int], *, enabled: bool) -> None:
        values = self._values
        if values[_STATE] == ARMED and self._triggers(sample, enabled=enabled):
            values[_STATE] = RECORDING
            values[_CYCLE] = values[_CYCLES]
            while len(self._kept) > values[_BEFORE]:
                self._kept.popleft()
        self._last = sample
        self._kept.append(sample)
        if values[_STATE] == ARMED and len(self._kept) > values[_BEFORE]:
            self._kept.popleft()
        values[_COUNT] = len(self._kept)
        if values[_STATE] == RECORDING and len(self._kept) >= values[_SAMPLES]:
            values[_STATE] = COMPLETE
            self.running = False

    def _triggers(self, sample: tuple[int, int], *, enabled: bool) -> bool:
        kind: int = self._values[_TRIGGER]
        level: int = self._values[_LEVEL]
        if kind == AT_ONCE:
            return True
        if kind == ENABLED:
            return enabled
        if kind == CURRENT:
            return abs(sample[1]) >= level
        if self._last is None:
            return False
        before, now = self._last[0], sample[0]
        return before < level <= now if kind == RISING else before > level >= now

    def _check(self, entry: Entry, value: Value) -> None:
        if entry.sub != 1 and self.running:  # the set-up of a recording that runs stays as it is
            raise SdoError(Abort.STATE)
        if entry.key == _PERIOD:
            steps = int(value) / self._grid_us
            if abs(steps - round(steps)) > 1e-6:
                raise SdoError(Abort.VALUE)
        elif entry.key == _BEFORE and int(value) >= self._values[_SAMPLES]:
            raise SdoError(Abort.INCOMPATIBLE)

    def _control(self) -> None:
        """0x2040:1 arms at 1, whatever was recorded before; 0 stops and keeps."""
        values = self._values
        wanted = values[_CONTROL]
        if wanted and not self.running:
            self.reset()
            self.running = True
            values[_STATE], values[_COUNT] = ARMED, 0
        elif not wanted and self.running:
            self.running = False
            values[_STATE] = COMPLETE if values[_STATE] == RECORDING else IDLE
