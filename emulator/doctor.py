"""What this machine offers an emulated rig."""

import os
import socket
from collections.abc import Iterator

import numpy as np

from emulator.machine import load_machine
from emulator.priority import real_time
from emulator.rig import EmulatedRig
from protocols import nmt
from protocols.checks import Check
from protocols.clock import Clock, RealClock
from protocols.rig import Rig, load_rig

LATENESS_S = 0.5
PERIOD_NS = 1_000_000
LATE_MS = 1.0  # p99 of a 1 kHz loop that still looks like real time


def checks(rig_name: str = "tx40-rig") -> Iterator[Check]:
    """Look at CAN, ports, timer and kernels, the slow ones last."""
    rig, _ = load_rig(rig_name)
    yield _vcan()
    yield from _ports(rig)
    yield _timer()
    yield _kernels(rig_name)


def _vcan() -> Check:
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW):
            found = [name for _, name in socket.if_nameindex() if "can" in name]
    except OSError as error:
        return Check("SocketCAN", False, f"the kernel has none ({error.strerror}); rigs run on the virtualcan hub.")
    if not found:
        how = "create one with: ip link add vcan0 type vcan && ip link set vcan0 up"
        return Check("SocketCAN", False, f"the kernel has it, but there is no interface; {how}.")
    return Check("SocketCAN", True, f"interfaces {', '.join(found)}.")


def _ports(rig: Rig) -> Iterator[Check]:
    places = {f"bus {b.name}": b.channel for b in rig.bus if b.interface == "virtualcan" and ":" in b.channel}
    if rig.cell is not None:
        places["cell (Modbus/TCP)"] = f"{rig.cell.host}:{rig.cell.port}"
    places["Zenoh"] = rig.zenoh.endpoint.partition("/")[2]
    for name, place in places.items():
        host, _, port = place.rpartition(":")
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, int(port)))
            except OSError as error:
                yield Check(name, False, f"{place}: {error.strerror}; another armrig may be running.")
                continue
        yield Check(name, True, f"{place} is free.")


def _timer() -> Check:
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    granted = real_time()
    late = _lateness(RealClock())
    os.sched_setscheduler(0, *before)
    p50, p99, worst = (float(v) for v in np.percentile(late, [50, 99, 100]) * 1e-6)
    detail = f"a 1 kHz loop is late by {p50:.2f} ms (median), {p99:.2f} ms (p99), {worst:.2f} ms (worst)"
    return Check("timer", p99 < LATE_MS, f"{detail}, {'with' if granted else 'without'} real-time priority.")


def _lateness(clock: Clock) -> list[int]:
    late, due = [], clock.now_ns()
    for _ in range(int(LATENESS_S * 1e9) // PERIOD_NS):
        due += PERIOD_NS
        late.append(clock.sleep_until(due))
    return late


def _kernels(rig_name: str) -> Check:
    """Runs the emulated rig for a few cycles: compiles what is not in the cache, and times the rest."""
    clock = RealClock()
    rig, robot = load_rig(rig_name)
    arm = EmulatedRig(rig, load_machine(rig, robot))
    arm.start(0)
    arm.step(0, [[nmt.command(nmt.Command.START)] for _ in rig.bus])
    arm.step(PERIOD_NS, [[nmt.sync(1)] for _ in rig.bus])
    compiled_s = clock.now_ns() * 1e-9
    begin, cycles = clock.now_ns(), 200
    for n in range(2, 2 + cycles):
        arm.step(n * PERIOD_NS, [[nmt.sync(nmt.next_counter(n - 1, rig.sync_overflow))] for _ in rig.bus])
    cycle_us = (clock.now_ns() - begin) / cycles * 1e-3
    detail = f"ready after {compiled_s:.1f} s; a cycle of {len(rig.drive)} drives takes {cycle_us:.0f} us of 1000."
    return Check("emulator", cycle_us < PERIOD_NS * 1e-3, detail)
