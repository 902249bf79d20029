"""The emulated rig: six drives on their buses around one arm, in step with SYNC.

SYNC is the clock. The first SYNC of a new instant advances the arm by one period; the SYNC of every other bus with
the same counter latches the same instant, so all drives see one arm however the buses are scheduled. A late
host therefore stretches the emulated time instead of bending the physics. Without SYNC the arm follows `t_ns`.
"""

from collections import deque
from collections.abc import Sequence

import numpy as np

from emulator.drive import Drive, Measurement
from emulator.plant import Plant
from protocols import nmt
from protocols.cell import CellState
from protocols.frames import Frame
from protocols.rig import Rig
from protocols.robot import Robot

SILENT_PERIODS = 20  # without SYNC for so long, the arm follows the clock: a host at rest must not freeze it
NO_COUNTER = -1
PATIENCE_PERIODS = 2  # how long one bus waits for the SYNC of another before going on alone


class _Segment:
    """One bus as the rig sees it: who is on it and which frames wait to be handled."""

    def __init__(self, drives: list[tuple[int, Drive]]) -> None:
        self.drives = drives
        self.waiting: deque[Frame] = deque()
        self.latched = False  # has seen the SYNC of the present instant
        self.active = False  # carries SYNC

    def counter(self) -> int:
        """Counter of the SYNC that waits."""
        data = self.waiting[0].data
        return data[0] if data else NO_COUNTER


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
        self.drives = [Drive(joint.drive, place[joint.name].node) for joint in machine.joint]
        self._segments = [
            _Segment(
                [
                    (j, drive)
                    for j, (joint, drive) in enumerate(zip(machine.joint, self.drives, strict=True))
                    if place[joint.name].bus == bus.name
                ]
            )
            for bus in rig.bus
        ]
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

    def start(self, t_ns: int) -> list[list[Frame]]:
        """Power on: the boot-up messages, per bus."""
        return [[f for _, drive in s.drives for f in drive.start(t_ns)] for s in self._segments]

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
        progress = True
        while progress:
            for segment, sent in pairs:
                self._dispatch(t_ns, segment, sent)
            progress = any([self._sync(t_ns, segment, sent) for segment, sent in pairs])
        self._free_run(t_ns)
        for segment, sent in pairs:
            for _, drive in segment.drives:
                sent.extend(drive.tick(t_ns))
        return out

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
        waiting = segment.waiting
        while waiting and waiting[0].can_id != nmt.SYNC:
            frame = waiting.popleft()
            for _, drive in segment.drives:
                sent.extend(drive.receive(t_ns, frame))

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
            sent.extend(drive.on_sync(t_ns, None if counter == NO_COUNTER else counter, self._measured[j]))
            command = drive.command()
            self._mode[j], self._position[j], self._current[j] = command
            gains = drive.changed_gains()
            if gains is not None:
                self.plant.set_current_gains(j, *gains)
        return True

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
            self.plant.advance(self._mode, self._position, self._current)
        self._measure()
        self._counter, self._instant_ns, self._plant_ns = counter, t_ns, t_ns
        self.cycles += 1
        for segment in self._segments:
            segment.latched = False
        return True

    def _free_run(self, t_ns: int) -> None:
        if t_ns - self._instant_ns < SILENT_PERIODS * self.period_ns:
            return
        for j, drive in enumerate(self.drives):
            self._mode[j], self._position[j], self._current[j] = drive.command()
        while self._plant_ns + self.period_ns <= t_ns:
            self.plant.advance(self._mode, self._position, self._current)
            self._plant_ns += self.period_ns
        self._measure()

    def _measure(self) -> None:
        counts, speed, current = self.plant.measure()
        self._measured = list(map(Measurement, counts.tolist(), speed.tolist(), current.tolist()))
