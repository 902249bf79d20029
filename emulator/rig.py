"""The emulated rig: six drives on their buses around one arm, in step with SYNC.

SYNC is the clock. The first SYNC of a new instant advances the arm by one period; the SYNC of every other bus with
the same counter latches the same instant, so all drives see one arm however the buses are scheduled. A late
host therefore stretches the emulated time instead of bending the physics. Without SYNC the arm follows `t_ns`.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np

from emulator.axis import Measurement
from emulator.drive import Drive
from emulator.faults import Fault, Kind
from emulator.impaired import ImpairedDrive, Schedule
from emulator.plant import Plant
from protocols import nmt
from protocols.cell import CellState
from protocols.errorframes import Class, State, decode
from protocols.errors import ConfigError
from protocols.frames import ERROR, Frame
from protocols.rig import Rig
from protocols.robot import Joint, Robot

SILENT_PERIODS = 20  # without SYNC for so long, the arm follows the clock: a host at rest must not freeze it
NO_COUNTER = -1

Unit = Drive | ImpairedDrive
PATIENCE_PERIODS = 2  # how long one bus waits for the SYNC of another before going on alone


class _Segment:
    """One bus as the rig sees it: who is on it and which frames wait to be handled."""

    def __init__(self, name: str, drives: list[tuple[int, Unit]]) -> None:
        self.name = name
        self.drives = drives
        self.waiting: deque[Frame] = deque()
        self.overheard: deque[tuple[Unit, Frame]] = deque()  # sent by one drive, meant for another
        self.off: set[Unit] = set()  # whose controllers are bus-off
        self.latched = False  # has seen the SYNC of the present instant
        self.active = False  # carries SYNC

    def counter(self) -> int:
        """Counter of the SYNC that waits."""
        data = self.waiting[0].data
        return data[0] if data else NO_COUNTER


Pairs = Sequence[tuple[_Segment, list[Frame]]]  # buses, and what they get to carry


class EmulatedRig:
    """Frames in, frames out; no clock, no socket.

    Args:
        rig: Buses, nodes, period.
        machine: The arm as it really is.
    """

    def __init__(self, rig: Rig, machine: Robot) -> None:
        joints = machine.joints
        self.period_ns = rig.sync_period_us * 1000
        noise = rig.emulated
        self.plant = Plant(
            machine,
            self.period_ns * 1e-9,
            np.random.default_rng(noise.seed),
            np.broadcast_to(np.array(noise.current_noise_A), joints).copy(),
            np.broadcast_to(np.array(noise.encoder_noise_rad), joints).copy(),
        )
        place = {d.joint: d for d in rig.drive}
        rates = {bus.name: bus.bitrate for bus in rig.bus}
        self.drives = [
            Drive(
                joint.drive,
                place[joint.name].node,
                period_ns=self.period_ns,
                travel=_travel(joint),
                grid_s=self.plant.substep_s,
                bit_rate=rates[place[joint.name].bus],
            )
            for joint in machine.joint
        ]
        self._segments = [
            _Segment(
                bus.name,
                [
                    (j, drive)
                    for j, (joint, drive) in enumerate(zip(machine.joint, self.drives, strict=True))
                    if place[joint.name].bus == bus.name
                ],
            )
            for bus in rig.bus
        ]
        self._joints = machine.joint_names
        self._schedule = Schedule()
        self._tracing = False
        self._supply_V = max(joint.drive.bus_voltage_V for joint in machine.joint)
        self._mode = np.zeros(joints, dtype=np.int64)
        self._position = np.zeros(joints)
        self._current = np.zeros(joints)
        self._counter = NO_COUNTER  # of the present instant
        self._instant_ns = 0  # when the present instant began
        self._plant_ns = 0  # up to where the arm has been simulated without SYNC
        self.cycles = 0
        self.skewed = 0  # instants at which a bus had to go on without another
        self._measure()

    @property
    def nodes(self) -> list[list[int]]:
        """Node numbers of the drives on each bus."""
        return [[drive.device.node_id for _, drive in segment.drives] for segment in self._segments]

    def start(self, t_ns: int) -> list[list[Frame]]:
        """Power on: the boot-up messages, per bus."""
        return [[f for _, drive in s.drives for f in drive.start(t_ns)] for s in self._segments]

    def schedule(self, fault: Fault) -> None:
        """Have something go wrong later.

        Raises:
            ConfigError: There is no such joint or bus; says which there are.
        """
        buses = [segment.name for segment in self._segments]
        if fault.place and fault.place not in {*self._joints, *buses}:
            raise ConfigError(
                f"fault {fault.text}: the rig has no {fault.place}; write one of {', '.join([*buses, *self._joints])}."
            )
        for segment in self._segments:
            for n, (j, drive) in enumerate(segment.drives):
                if fault.place in {"", segment.name, self._joints[j]}:
                    impaired = drive if isinstance(drive, ImpairedDrive) else ImpairedDrive(drive)
                    segment.drives[n] = j, impaired
                    self._schedule.add(fault, impaired)
                    if fault.kind is Kind.GARBAGE and fault.place in {"", segment.name}:
                        break  # once per bus, not per drive

    def step(self, t_ns: int, received: Sequence[Sequence[Frame]]) -> list[list[Frame]]:
        """Handle what has arrived on each bus and what is due by `t_ns`.

        Args:
            t_ns: Now.
            received: Frames per bus, in the order of `rig.bus`.

        Returns:
            Frames to send, per bus.
        """
        out: list[list[Frame]] = [[] for _ in self._segments]
        for segment, frames in zip(self._segments, received, strict=True):
            segment.waiting.extend(frames)
        pairs = list(zip(self._segments, out, strict=True))
        if t_ns >= self._schedule.next_ns:
            self._go_wrong(t_ns, pairs)
        progress = True
        while progress:
            for segment, sent in pairs:
                self._dispatch(t_ns, segment, sent)
            progress = any([self._sync(t_ns, segment, sent) for segment, sent in pairs])
        self._free_run(t_ns, pairs)
        for segment, sent in pairs:
            for _, drive in segment.drives:
                _say(segment, drive, drive.tick(t_ns), sent)
        return out

    def _go_wrong(self, t_ns: int, pairs: Pairs) -> None:
        for victim, frames in self._schedule.run(t_ns):
            for segment, sent in pairs:
                if any(drive is victim for _, drive in segment.drives):
                    _say(segment, victim, frames, sent)

    def cell(self) -> CellState:
        """What the cell's sensors see of the machine."""
        return CellState(
            motor_temperature_C=tuple(self.plant.motor_temperature_C.tolist()),
            ambient_temperature_C=self.plant.ambient_C,
            supply_V=self._supply_V,
            brake_released=bool(self._mode.all()),
        )

    def _dispatch(self, t_ns: int, segment: _Segment, sent: list[Frame]) -> None:
        """Everything up to the next SYNC."""
        for _ in range(len(segment.overheard)):  # what they say to each other meanwhile is for the next time
            speaker, frame = segment.overheard.popleft()
            for _, drive in segment.drives:
                if drive is not speaker and drive not in segment.off:
                    _say(segment, drive, drive.receive(t_ns, frame), sent)
        waiting = segment.waiting
        while waiting and waiting[0].can_id != nmt.SYNC:
            frame = waiting.popleft()
            if frame.can_id & ERROR:
                _review(t_ns, segment, frame, sent)
                continue
            for _, drive in segment.drives:
                answer = [] if drive in segment.off else drive.receive(t_ns, frame)
                if answer:
                    _say(segment, drive, answer, sent)

    def _sync(self, t_ns: int, segment: _Segment, sent: list[Frame]) -> bool:
        """Handle the SYNC at the head of a bus, if its instant has come."""
        if not segment.waiting:
            return False
        counter = segment.counter()
        fresh = t_ns - self._instant_ns < self.period_ns // 2  # all that is known of a SYNC without a counter
        same = not segment.latched and (counter == self._counter if counter != NO_COUNTER else fresh)
        if not same and not self._next_instant(t_ns, counter):
            return False
        segment.waiting.popleft()
        segment.latched = segment.active = True
        for j, drive in segment.drives:
            if drive in segment.off:
                drive.proceed(t_ns, self._measured[j])
            else:
                answer = drive.on_sync(t_ns, None if counter == NO_COUNTER else counter, self._measured[j])
                _say(segment, drive, answer, sent)
            self._obey(j, drive)
        return True

    def _obey(self, j: int, drive: Unit) -> None:
        """Hand a drive's wishes to its power stage."""
        self._mode[j], self._position[j], self._current[j] = drive.command()
        gains, limit_A = drive.changed_gains(), drive.changed_limit()
        if gains is not None:
            self.plant.set_current_gains(j, *gains)
        if limit_A is not None:
            self.plant.set_current_limit(j, limit_A)

    def _next_instant(self, t_ns: int, counter: int) -> bool:
        """Advance the arm by one period unless another bus still owes the present instant's SYNC."""
        owing = [
            s for s in self._segments if s.active and not s.latched and (not s.waiting or s.counter() == self._counter)
        ]
        if owing and t_ns - self._instant_ns < PATIENCE_PERIODS * self.period_ns:
            return False
        for segment in owing:
            segment.active = False
            self.skewed += 1
        if t_ns - self._instant_ns < SILENT_PERIODS * self.period_ns:
            self._advance()
        else:
            self._measure()
        self._counter, self._instant_ns, self._plant_ns = counter, t_ns, t_ns
        self.cycles += 1
        for segment in self._segments:
            segment.latched = False
        return True

    def _free_run(self, t_ns: int, pairs: Pairs) -> None:
        """Without SYNC the arm, and the drives' own motions, go on with the clock."""
        if t_ns - self._instant_ns < SILENT_PERIODS * self.period_ns:
            return
        while self._plant_ns + self.period_ns <= t_ns:
            self._plant_ns += self.period_ns
            self._advance()
            for segment, sent in pairs:
                for j, drive in segment.drives:
                    _say(segment, drive, drive.proceed(self._plant_ns, self._measured[j]), sent)
                    self._obey(j, drive)

    def _advance(self) -> None:
        """One period of the arm."""
        tracing = any(drive.recorder.running for drive in self.drives)
        if tracing is not self._tracing:
            self._tracing = tracing
            self.plant.keep_trace(wanted=tracing)
        self.plant.advance(self._mode, self._position, self._current)
        if tracing:
            counts, current_A = self.plant.trace()
            for j, drive in enumerate(self.drives):
                if drive.recorder.running:
                    drive.record(counts[:, j].tolist(), current_A[:, j].tolist())
        self._measure()

    def _measure(self) -> None:
        counts, speed, current = self.plant.measure()
        self._measured = list(map(Measurement, counts.tolist(), speed.tolist(), current.tolist()))


def _say(segment: _Segment, speaker: Unit, frames: list[Frame], sent: list[Frame]) -> None:
    """A drive sends; the others on its bus may be listening. They hear it with the rig's next step."""
    if speaker in segment.off:
        return
    sent.extend(frames)
    for frame in frames:
        if frame.can_id == nmt.SYNC:  # a drive is the producer: everybody takes part, itself included
            segment.waiting.append(frame)
        elif any(drive.device.hears(frame.can_id) for _, drive in segment.drives if drive is not speaker):
            segment.overheard.append((speaker, frame))


def _review(t_ns: int, segment: _Segment, frame: Frame, sent: list[Frame]) -> None:
    """A controller reports about itself: off the bus a drive neither speaks nor hears, and takes care of itself."""
    report = decode(frame)
    for _, drive in segment.drives:
        if report.station not in {0, drive.device.node_id}:
            continue
        if report.state is State.BUS_OFF and drive not in segment.off:
            segment.off.add(drive)
            drive.device.lose_bus(t_ns)
        elif report.classes & Class.RESTARTED and drive in segment.off:
            segment.off.remove(drive)
            _say(segment, drive, drive.device.find_bus(t_ns), sent)


def _travel(joint: Joint) -> tuple[int, int]:
    """Encoder counts at which the limit switches of an axis close: the ends of its joint's range."""
    ends = [round(limit * joint.drive.counts_per_rad) for limit in (joint.position_min_rad, joint.position_max_rad)]
    return min(ends), max(ends)
