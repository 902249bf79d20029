"""The outer loops in real time: the only places of the emulator that wait."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from emulator.bus import FrameBus, receive_any
from emulator.host import Host
from emulator.rig import EmulatedRig
from protocols.clock import Clock
from protocols.frames import Frame

IDLE_WAIT_S = 0.001  # how long the rig listens before it looks at its own timers
FEEDBACK_PATIENCE_PERIODS = 20  # a host on an emulated rig waits for late answers; beyond that it goes on without


def emulate(
    rig: EmulatedRig,
    buses: Sequence[FrameBus],
    clock: Clock,
    stop: threading.Event,
    duration_s: float | None = None,
    every_100_ms: Callable[[], None] | None = None,
) -> None:
    """Run the emulated rig on its buses until stopped.

    Raises:
        PeerError: A bus has gone.
    """
    end_ns = None if duration_s is None else int(duration_s * 1e9)
    _send(buses, rig.start(clock.now_ns()))
    next_update = 0
    while not stop.is_set():
        received = receive_any(buses, IDLE_WAIT_S)
        t_ns = clock.now_ns()
        _send(buses, rig.step(t_ns, received))
        if t_ns >= next_update and every_100_ms is not None:
            every_100_ms()
            next_update = t_ns + 100_000_000
        if end_ns is not None and t_ns >= end_ns:
            return


def _send(buses: Sequence[FrameBus], frames: Sequence[Sequence[Frame]]) -> None:
    for bus, batch in zip(buses, frames, strict=True):
        if batch:
            bus.send(batch)


@dataclass(frozen=True)
class Punctuality:
    """How well a real-time run kept its cycle.

    Attributes:
        cycles: SYNC periods.
        seconds: Real time they took.
        late: Cycles that began more than a tenth of a period after their time.
        slipped: Cycles that were more than a period late: the grid was shifted, no burst of SYNCs made up for it.
        worst_s: Largest lateness.
        unanswered: Cycles that began before every drive had answered the one before.
    """

    cycles: int
    seconds: float
    late: int
    slipped: int
    worst_s: float
    unanswered: int

    def __str__(self) -> str:
        return (
            f"{self.cycles} cycles in {self.seconds:.2f} s; {self.late} late by more than a tenth of a period,"
            f" {self.slipped} by more than a period (worst {self.worst_s * 1e3:.2f} ms);"
            f" {self.unanswered} without an answer from every drive"
        )


def move(host: Host, buses: Sequence[FrameBus], clock: Clock, stop: threading.Event, period_ns: int) -> Punctuality:
    """Run a host's script in real time, SYNC on a fixed grid; a cycle late by more than a period shifts the grid.

    Raises:
        PeerError: A drive does not answer or has a fault, or a bus has gone.
    """
    script = host.script()
    frames = next(script)
    cycles = late = slipped = unanswered = worst_ns = 0
    begin_ns = due_ns = clock.now_ns()
    while True:
        _send(buses, frames)
        due_ns += period_ns
        inbox, missing = _gather(host, buses, clock, due_ns, due_ns + FEEDBACK_PATIENCE_PERIODS * period_ns)
        now_ns = clock.now_ns()
        late_ns = now_ns - due_ns
        cycles += 1
        unanswered += missing > 0
        worst_ns = max(worst_ns, late_ns)
        late += late_ns > period_ns // 10
        if late_ns > period_ns:
            slipped += 1
            due_ns = now_ns
        if stop.is_set():
            host.stop()
        try:
            frames = script.send(inbox)
        except StopIteration:
            return Punctuality(cycles, (now_ns - begin_ns) * 1e-9, late, slipped, worst_ns * 1e-9, unanswered)


def _gather(
    host: Host, buses: Sequence[FrameBus], clock: Clock, due_ns: int, latest_ns: int
) -> tuple[list[list[Frame]], int]:
    """All that arrives until `due_ns`; up to `latest_ns` while feedback is missing.

    A drive emulated on a busy machine may be a little late, and a control law fed with old positions is worse than
    a stretched period.

    Returns:
        Frames per bus, and how many answers are still missing.
    """
    inbox: list[list[Frame]] = [[] for _ in buses]
    missing = host.expected_answers
    now = clock.now_ns()
    while missing > 0 and now < latest_ns:
        for kept, fresh in zip(inbox, receive_any(buses, (latest_ns - now) * 1e-9), strict=True):
            kept.extend(fresh)
            missing -= host.answers_in(fresh)
        now = clock.now_ns()
    clock.sleep_until(due_ns)
    for kept, fresh in zip(inbox, receive_any(buses, 0), strict=True):
        kept.extend(fresh)
    return inbox, missing
