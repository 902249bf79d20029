"""Rig and host in simulated time: as fast as the CPU allows, through the same frames as on a bus."""

from collections.abc import Callable, Sequence

from emulator.host import Host
from emulator.rig import EmulatedRig
from protocols.frames import Frame

Tap = Callable[[int, int, Sequence[Frame]], None]  # (t_ns, bus index, frames) of all that passes in simulated time


def lockstep(rig: EmulatedRig, host: Host, period_ns: int, tap: Tap, stopped: Callable[[], bool] = bool) -> int:
    """Run rig and host in simulated time.

    Args:
        tap: Told of all that passes on the buses, in order: the host's burst at the cycle's time, the answers with it.
        stopped: Asked every cycle; the host brakes when it says so.

    Returns:
        Simulated time [ns].

    Raises:
        PeerError: As the host's script.
    """
    t_ns = 0
    for bus, frames in enumerate(rig.start(t_ns)):
        tap(t_ns, bus, frames)
    script = host.script()
    burst = next(script)
    while True:
        t_ns += period_ns
        answers = rig.step(t_ns, burst)
        for bus, (sent, received) in enumerate(zip(burst, answers, strict=True)):
            tap(t_ns, bus, sent)
            tap(t_ns, bus, received)
        if stopped():
            host.stop()
        try:
            burst = script.send(answers)
        except StopIteration:
            return t_ns
