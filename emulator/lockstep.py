"""Rig and host in simulated time: as fast as the CPU allows, through the same frames as on a bus."""

from collections.abc import Callable, Sequence
from typing import Protocol

from emulator.host import Host
from emulator.rig import EmulatedRig
from emulator.wire import Wire
from protocols.frames import Frame

Tap = Callable[[int, int, Sequence[Frame]], None]  # (t_ns, bus index, frames) of all that a listener hears, in order

HOST, LISTENER = "host", "listener"  # stations on a wire; drives are there under their node numbers


class Exchange(Protocol):
    """What carries frames between rig and host."""

    def start(self) -> None:
        """Power on."""

    def cycle(self, t_ns: int, burst: Sequence[Sequence[Frame]]) -> list[list[Frame]]:
        """One period from `t_ns` on: the host's burst at its beginning, and what the host has heard by its end."""


class IdealBuses:
    """Buses without time: whatever is sent is answered at once."""

    def __init__(self, rig: EmulatedRig, tap: Tap) -> None:
        self._rig, self._tap = rig, tap

    def start(self) -> None:
        for bus, frames in enumerate(self._rig.start(0)):
            self._tap(0, bus, frames)

    def cycle(self, t_ns: int, burst: Sequence[Sequence[Frame]]) -> list[list[Frame]]:
        answers = self._rig.step(t_ns, burst)
        for bus, (sent, received) in enumerate(zip(burst, answers, strict=True)):
            self._tap(t_ns, bus, sent)
            self._tap(t_ns, bus, received)
        return answers


class TrueBuses:
    """Buses with time: frames wait for the bus, take as long as they are, and may meet faults.

    Args:
        wires: One per bus, empty.
        nodes: Node numbers of the drives on each bus.
    """

    def __init__(
        self, rig: EmulatedRig, wires: Sequence[Wire], nodes: Sequence[Sequence[int]], period_ns: int, tap: Tap
    ) -> None:
        self._rig, self._wires, self._tap, self._period_ns = rig, wires, tap, period_ns
        self._stations = [{n: n if n in known else min(known, default=0) for n in range(128)} for known in nodes]
        for wire, known in zip(wires, nodes, strict=True):
            wire.join(0, HOST)
            wire.join(0, LISTENER)
            for node in known:
                wire.join(0, node, node)

    def start(self) -> None:
        self._answer(0, self._rig.start(0))

    def cycle(self, t_ns: int, burst: Sequence[Sequence[Frame]]) -> list[list[Frame]]:
        inbox = self._box()
        self._answer(t_ns, self._rig.step(t_ns, inbox))
        for wire, frames in zip(self._wires, burst, strict=True):
            for frame in frames:
                wire.offer(t_ns, HOST, frame)
        while (due_ns := min(wire.next_ns for wire in self._wires)) < t_ns + self._period_ns:
            to_rig = self._box()
            for bus, wire in enumerate(self._wires):
                self._sort(bus, wire, due_ns, inbox[bus], to_rig[bus])
            if any(to_rig):
                self._answer(due_ns, self._rig.step(due_ns, to_rig))
        return inbox

    def _sort(self, bus: int, wire: Wire, t_ns: int, to_host: list[Frame], to_rig: list[Frame]) -> None:
        """What is heard by `t_ns`, to whom it concerns."""
        for heard in wire.advance(t_ns):
            if heard.to is None:
                if wire.hears(LISTENER):
                    self._tap(heard.t_ns, bus, [heard.frame])
                if HOST in heard.senders:
                    to_rig.append(heard.frame)
                elif wire.hears(HOST):
                    to_host.append(heard.frame)
            elif heard.to == LISTENER:
                self._tap(heard.t_ns, bus, [heard.frame])
            elif heard.to == HOST:
                to_host.append(heard.frame)
            else:
                to_rig.append(heard.frame)

    def _answer(self, t_ns: int, answers: Sequence[Sequence[Frame]]) -> None:
        for wire, stations, frames in zip(self._wires, self._stations, answers, strict=True):
            for frame in frames:
                wire.offer(t_ns, stations[frame.can_id & 0x7F], frame)

    def _box(self) -> list[list[Frame]]:
        return [[] for _ in self._wires]


def lockstep(
    rig: EmulatedRig,
    host: Host,
    period_ns: int,
    tap: Tap,
    stopped: Callable[[], bool] = bool,
    wires: Sequence[Wire] | None = None,
) -> int:
    """Run rig and host in simulated time.

    Args:
        tap: Told of all that a listener on the buses hears, in order.
        stopped: Asked every cycle; the host brakes when it says so.
        wires: One per bus; without, buses are ideal: the host's burst comes at the cycle's time, the answers with it.

    Returns:
        Simulated time [ns].

    Raises:
        PeerError: As the host's script.
    """
    t_ns = 0
    buses: Exchange = IdealBuses(rig, tap) if wires is None else TrueBuses(rig, wires, rig.nodes, period_ns, tap)
    buses.start()
    script = host.script()
    burst = next(script)
    while True:
        t_ns += period_ns
        answers = buses.cycle(t_ns, burst)
        if stopped():
            host.stop()
        try:
            burst = script.send(answers)
        except StopIteration:
            return t_ns
