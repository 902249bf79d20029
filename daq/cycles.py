"""From SYNCs and TPDO1s to cycles on the SYNC time grid.

Frames are put in order by what they carry, never by when they arrived: on a busy host the TPDO1 of SYNC n may be
read after SYNC n + 5, and a lost SYNC does not keep the drives from answering it. So the SYNC counter gives each bus
its index, and the drive's own count of SYNCs (0x2001) gives each TPDO1 its index. Arrival times decide two things
only: that SYNC stopped for a while, and that a jump of a counter is too large to be true.

A cycle is handed on when it is `HOLD` SYNCs old and no drive that still reports can add to it.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

from daq.integrity import BusCounters, DriveCounters, Integrity

HOLD = 64  # cycles kept open, so that what is learnt about a drive's index within them still applies to them
PAUSE_NS = 500_000_000  # without any SYNC for so long, the host has stopped: a stall of ours is rarely so long
PATIENCE_NS = 1_000_000_000  # a drive that has been silent for so long is not waited for
WINDOW = 1000  # TPDO1s after which a drive that always came late is known to have missed a SYNC
COUNTER_MODULUS = 1 << 16  # 0x2001 is an UNSIGNED16

Sample = tuple[int, int, int, bool]  # position, current, counter, missing
_ABSENT: Sample = (0, 0, 0, True)


class Cycle(NamedTuple):
    """All drives at one SYNC, in the order of the robot's joints.

    Attributes:
        sync: SYNC index; times the period it is the time of the latched values.
        t_ns: Arrival of the SYNC.
        missing: The drive's TPDO1 was not received; its values are 0.
    """

    sync: int
    t_ns: int
    position: tuple[int, ...]
    current: tuple[int, ...]
    counter: tuple[int, ...]
    missing: tuple[bool, ...]


@dataclass(slots=True, eq=False)
class SyncLine:
    """SYNC of one bus.

    Attributes:
        index: Of the last SYNC; None before the first.
        counter, t_ns: What it carried (None: no counter), when it arrived.
        repeated: The counter came again: a duplicate, unless the drives tell of a whole turn that was lost.
        ahead: Drives whose last TPDO1 claims a SYNC that has not been seen: either it was lost, or the drive's index
            was learnt from a late TPDO1. The next SYNC tells.
    """

    counters: BusCounters
    index: int | None = None
    counter: int | None = None
    t_ns: int = 0
    repeated: bool = False
    ahead: set["DriveLine"] = field(default_factory=set)


@dataclass(slots=True, eq=False)
class DriveLine:
    """TPDO1 of one drive.

    Attributes:
        index: SYNC index of the last sample by the drive's own count; None until (re)learnt from the bus.
        counter, t_ns: What the last sample carried, when it arrived.
        start: Index of the first sample since the index was learnt.
        fresh: Nothing received since SYNC began: cycles before the first sample are not lost.
        late_start: Was fresh when the index was learnt.
        excused: Told to stop, or restarted: its count may jump without loss.
        silent: Cycles without this drive that its counter has not accounted for.
        lateness, seen: Least distance behind the bus among that many samples.
        samples: Not handed on yet, by index.
    """

    joint: str
    sync: SyncLine
    counters: DriveCounters
    index: int | None = None
    counter: int = 0
    t_ns: int = 0
    start: int = 0
    fresh: bool = True
    late_start: bool = True
    excused: bool = False
    silent: int = 0
    lateness: int = WINDOW
    seen: int = 0
    samples: dict[int, Sample] = field(default_factory=dict)

    def learn(self, index: int) -> None:
        """Take the index from the bus."""
        if not self.fresh:
            self.counters.lost += self.silent
        self.index = self.start = index
        self.late_start, self.fresh, self.excused = self.fresh, False, False
        self.silent, self.lateness, self.seen = 0, WINDOW, 0

    def shift(self, cycles: int) -> None:
        """Correct the index, and that of the samples not handed on."""
        if self.index is not None:
            self.index += cycles
            self.start += cycles
            self.samples = {index + cycles: sample for index, sample in self.samples.items()}

    def lost(self, step: int, most: float) -> int:
        """TPDO1s that a step of the counter says are missing; none if it is no credible step."""
        return step - 1 if not self.excused and 1 < step <= most else 0


class Assembler:
    """Cycles of a rig.

    Attributes:
        drives: In the order of the robot's joints.
        ready: Finished cycles, in order; the caller takes them.
        notes: What it noticed: (t_ns, source, text); the caller takes them.
    """

    def __init__(self, joints: list[tuple[str, str]], period_ns: int, overflow: int, integrity: Integrity) -> None:
        """Start with nothing known.

        Args:
            joints: Pairs (joint, bus) in the order of the robot.
            overflow: Largest SYNC counter (0x1019).
        """
        self.buses = {bus: SyncLine(counters) for bus, counters in integrity.bus.items()}
        self.drives = [DriveLine(j, self.buses[bus], integrity.drive[j]) for j, bus in joints]
        self.ready: list[Cycle] = []
        self.notes: list[tuple[int, str, str]] = []
        self._period_ns = period_ns
        self._overflow = overflow
        self._foremost: int | None = None  # index, counter and arrival of the latest SYNC on any bus
        self._foremost_counter: int | None = None
        self._foremost_t_ns = 0
        self._arrival: dict[int, int] = {}
        self._next = 0

    def sync(self, t_ns: int, bus: str, counter: int | None) -> None:
        """A SYNC has arrived; `counter` is None where it carries none."""
        line = self.buses[bus]
        if self._foremost is None or t_ns - self._foremost_t_ns > PAUSE_NS:
            self._start(t_ns, bus, counter)
        if line.index is None:
            line.index = self._aligned(counter)
        elif counter is None or line.counter is None:
            line.index += 1
        elif t_ns - line.t_ns > PAUSE_NS:  # this bus was away, others were not
            index = self._aligned(counter)
            line.counters.lost += max(0, index - line.index - 1)
            line.index = index
        else:
            step = (counter - line.counter) % self._overflow
            if step == 0:
                line.counters.duplicated += 1
                line.repeated = True
                return
            if line.ahead:
                self._explain(line, line.index + step)
            line.counters.lost += step - 1
            line.index += step
        line.counter, line.t_ns, line.repeated = counter, t_ns, False
        line.counters.syncs += 1
        line.counters.uncounted += counter is None
        if self._foremost is None or line.index > self._foremost:
            self._foremost, self._foremost_counter, self._foremost_t_ns = line.index, counter, t_ns
            self._arrival[line.index] = t_ns
            self._hand_on(line.index - HOLD, t_ns)

    def feedback(self, t_ns: int, drive: DriveLine, position: int, current: int, counter: int) -> None:
        """A TPDO1 with the drive's cycle counter has arrived."""
        now, index = drive.sync.index, drive.index
        if now is None:
            return  # before the first SYNC: there is no cycle to put it in
        step = (counter - drive.counter) % COUNTER_MODULUS
        if index is not None and step == 1:
            index += 1
            drive.excused = False
        elif index is not None and (step == 0 or step >= COUNTER_MODULUS - HOLD):
            drive.counters.duplicated += 1  # the same again, or one from before
            return
        else:
            most = (t_ns - drive.t_ns + PATIENCE_NS) / self._period_ns if drive.counters.frames else 0
            lost = drive.lost(step, most)
            drive.counters.lost += lost
            if index is not None and lost:
                index += step
                drive.silent = 0
            else:
                drive.learn(now)
                index = now
        drive.index, drive.counter, drive.t_ns = index, counter, t_ns
        drive.counters.frames += 1
        if index >= self._next:
            drive.samples[index] = (position, current, counter, False)
        late = now - index
        if late < 0:
            drive.sync.ahead.add(drive)
        drive.lateness = min(drive.lateness, late)
        drive.seen += 1
        if drive.seen == WINDOW:
            self._review(t_ns, drive)

    def uncounted_feedback(self, t_ns: int, drive: DriveLine, position: int, current: int) -> None:
        """A TPDO1 without cycle counter has arrived: it is taken to answer the last SYNC."""
        index = drive.sync.index
        if index is None:
            return
        if drive.index is None:
            drive.learn(index)
        drive.index, drive.t_ns = index, t_ns
        drive.counters.frames += 1
        drive.counters.uncounted += 1
        if index >= self._next:
            drive.samples[index] = (position, current, 0, False)

    def finish(self, *, cut_off: bool = False) -> None:
        """The run is over: hand on what is left, and count drives that fell silent before the others.

        Args:
            cut_off: Not the run is over but its recording, on each bus at another time: the silence means nothing.
        """
        self._hand_on_all()
        for drive in [] if cut_off else self.drives:
            if drive.silent > (HOLD if drive.counters.frames else 0):  # buses do not stop at the very same SYNC
                drive.counters.lost += drive.silent
                self.notes.append((drive.t_ns, drive.joint, f"no TPDO1 in the last {drive.silent} cycles"))

    # --- SYNC index ---

    def _start(self, t_ns: int, bus: str, counter: int | None) -> None:
        """First SYNC, or first after a pause: the other buses align to this one."""
        if self._foremost is None:
            index = 0 if counter is None else counter
            self.notes.append((t_ns, bus, f"first SYNC, counter {counter}"))
        else:
            pause_ns = t_ns - self._foremost_t_ns
            self._hand_on_all()
            index = max(self._next, self._foremost + round(pause_ns / self._period_ns))
            self.notes.append((t_ns, bus, f"SYNC again after {pause_ns * 1e-9:.2f} s without"))
            for drive in self.drives:
                drive.index, drive.fresh, drive.silent = None, True, 0
        for line in self.buses.values():
            line.index = None
            line.ahead.clear()
        self._foremost, self._foremost_counter, self._foremost_t_ns = index, counter, t_ns
        self._arrival = {index: t_ns}
        self._next = index

    def _aligned(self, counter: int | None) -> int:
        """Index nearest to the foremost bus that has this counter."""
        index = self._foremost or 0
        if counter is None or self._foremost_counter is None:
            return index
        half = self._overflow // 2
        return index + (counter - self._foremost_counter + half) % self._overflow - half

    def _explain(self, line: SyncLine, coming: int) -> None:
        """Drives were ahead of the bus: by lost SYNCs if the SYNC that comes now skips as well; else either a whole
        turn of its counter was lost, or the drive's index was wrong."""
        for drive in line.ahead:
            if drive.index is None or line.index is None:
                continue
            surplus = drive.index - coming + 1
            turns = round(surplus / self._overflow)
            if turns > 0:
                line.index += turns * self._overflow
                line.counters.lost += turns * self._overflow - line.repeated
                line.counters.syncs += line.repeated
                line.counters.duplicated -= line.repeated
                line.repeated = False
                coming += turns * self._overflow
            elif surplus > 0:
                drive.shift(-surplus)
        line.ahead.clear()

    def _review(self, t_ns: int, drive: DriveLine) -> None:
        """A drive that came late in every single cycle of the window did not consume some SYNC."""
        missed = drive.lateness
        drive.lateness, drive.seen = WINDOW, 0
        if missed > 0:
            drive.shift(missed)
            drive.counters.lost += missed
            self.notes.append((t_ns, drive.joint, f"the drive missed {missed} SYNC within the last {WINDOW} cycles"))

    # --- cycles ---

    def _hand_on(self, until: int, t_ns: int) -> None:
        """Cycles up to `until`, as far as no reporting drive can still add to them."""
        while self._next <= until:
            for drive in self.drives:
                if drive.index is not None and drive.index < self._next and t_ns - drive.t_ns < PATIENCE_NS:
                    return
            self._emit()

    def _hand_on_all(self) -> None:
        last = max([-1, *(index for drive in self.drives for index in drive.samples)])
        while self._next <= last:
            self._emit()

    def _emit(self) -> None:
        n = self._next
        self._next = n + 1
        arrival = self._arrival.pop(n, self._foremost_t_ns)
        samples = [drive.samples.pop(n, _ABSENT) for drive in self.drives]
        position, current, counter, missing = zip(*samples, strict=True)
        if all(missing):
            return
        self.ready.append(Cycle(n, arrival, position, current, counter, missing))
        if any(missing):
            for drive, absent in zip(self.drives, missing, strict=True):
                if absent and (drive.index is None or n > drive.index):
                    drive.silent += 1
                elif absent and n < drive.start and not drive.late_start:
                    drive.counters.lost += 1
