"""The emulated rig in simulated time, beside real time."""

from collections.abc import Iterator

from emulator.host import Host
from emulator.lockstep import lockstep
from emulator.machine import load_machine
from emulator.rig import EmulatedRig
from protocols import config
from protocols.checks import Figure
from protocols.clock import RealClock
from protocols.motion import Motion
from protocols.rig import load_rig

RIG, MOTION = "tx40-rig", "tx40-test"


def figures() -> Iterator[Figure]:
    """Simulated seconds per second: arm, six drives, host and every frame between them, in one process."""
    rig, robot = load_rig(RIG)
    machine, plan = load_machine(rig, robot), config.read(config.locate(MOTION), Motion)
    period_ns = rig.sync_period_us * 1000
    speeds = []
    for _ in range(3):  # the first one compiles
        clock = RealClock()
        simulated_ns = lockstep(EmulatedRig(rig, machine), Host(rig, robot, plan), period_ns, lambda *_: None)
        speeds.append(simulated_ns / clock.now_ns())
    yield Figure("rig and host in lock-step", max(speeds), "s/s", "real time", 1.0, max(speeds))
