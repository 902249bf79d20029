"""Load of the CAN hub: two buses of three clients, 14 000 frames/s, each client and the hub a process of its own.

Run: python tests/benchmarks/hub_load.py [SECONDS]
"""

import json
import multiprocessing as mp
import resource
import sys
import time
from multiprocessing.connection import Connection

from emulator import hub
from emulator.virtualcan import VirtualCanBus
from protocols.frames import Frame

PERIOD_NS = 1_000_000
TARGETS = [0x301, 0x302, 0x303]
FEEDBACK = [0x181, 0x182, 0x183]
SYNC = 0x080
PATIENCE_S = 5.0


def cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def numbered(ids: list[int], n: int) -> list[Frame]:
    return [Frame(can_id, n.to_bytes(8, "big")) for can_id in ids]


def serve(pipe: Connection) -> None:
    imported_s = cpu_s()
    hub.serve([("can0", "127.0.0.1:0"), ("can1", "127.0.0.1:0")], pipe.send)
    pipe.send(cpu_s() - imported_s)


def host(channel: str, cycles: int, pipe: Connection) -> None:
    """Targets and SYNC every period, whatever comes back."""
    with VirtualCanBus(channel) as bus:
        answers, start = 0, time.monotonic_ns()
        for n in range(cycles):
            wait = start + n * PERIOD_NS - time.monotonic_ns()
            if wait > 0:
                time.sleep(wait * 1e-9)
            bus.write_frames([*numbered(TARGETS, n), Frame(SYNC, bytes([n % 240 + 1]))])
            answers += len(bus.read_frames(0))
        seconds = (time.monotonic_ns() - start) * 1e-9
        while answers < cycles * len(FEEDBACK) and (frames := bus.read_frames(PATIENCE_S)):
            answers += len(frames)
    pipe.send({"who": "host", "frames": answers, "seconds": round(seconds, 2)})


def drives(channel: str, cycles: int, pipe: Connection) -> None:
    """Feedback on every SYNC."""
    with VirtualCanBus(channel) as bus:
        pipe.send("joined")
        n = heard = 0
        while n < cycles and (frames := bus.read_frames(PATIENCE_S)):
            heard += len(frames)
            for frame in frames:
                if frame.can_id == SYNC:
                    bus.write_frames(numbered(FEEDBACK, n))
                    n += 1
    pipe.send({"who": "drives", "frames": heard})


def listener(channel: str, cycles: int, pipe: Connection) -> None:
    """Everything, checked for order."""
    count, out_of_order = 0, 0
    following = dict.fromkeys([*TARGETS, *FEEDBACK], 0)
    with VirtualCanBus(channel) as bus:
        pipe.send("joined")
        expected = cycles * (len(TARGETS) + 1 + len(FEEDBACK))
        while count < expected and (frames := bus.read_frames(PATIENCE_S)):
            count += len(frames)
            for frame in frames:
                if frame.can_id != SYNC:
                    n = int.from_bytes(frame.data, "big")
                    out_of_order += n != following[frame.can_id]
                    following[frame.can_id] = n + 1
    pipe.send({"who": "listener", "frames": count, "out_of_order": out_of_order})


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    cycles = int(seconds * 1e9 / PERIOD_NS)
    ours, theirs = mp.Pipe()
    server = mp.Process(target=serve, args=(theirs,))
    server.start()
    channels = ours.recv()
    started = []
    for role in (drives, listener, host):
        for channel in channels.values():
            here, there = mp.Pipe()
            process = mp.Process(target=role, args=(channel, cycles, there))
            process.start()
            if role is not host:
                here.recv()
            started.append((process, here))
    for process, pipe in started:
        print(json.dumps(pipe.recv()))
        process.join()
    server.terminate()
    print(json.dumps({"who": "hub", "percent_of_a_core": round(100 * ours.recv() / seconds, 1)}))
    server.join()


if __name__ == "__main__":
    mp.set_start_method("spawn")
    main()
