"""Load of the CAN hub: two buses of three clients, 14 000 frames/s, each client and the hub a process of its own.

Run: python tests/benchmarks/hub_load.py [seconds]
"""

import multiprocessing as mp
import resource
import sys
import time

from emulator import hub
from emulator.virtualcan import VirtualCanBus
from protocols.frames import Frame

PERIOD_NS = 1_000_000
HOST_BURST = 4  # three RPDO2 and the SYNC
DRIVE_BURST = 3  # three TPDO1


def cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF); print(used.ru_utime, used.ru_stime)
    return used.ru_utime + used.ru_stime


def serve(pipe) -> None:
    imported_s = cpu_s()
    hub.serve([("can0", "127.0.0.1:0"), ("can1", "127.0.0.1:0")], pipe.send)
    pipe.send(cpu_s() - imported_s)


def host(channel: str, cycles: int, pipe) -> None:
    bus = VirtualCanBus(channel)
    answers, start = 0, time.monotonic_ns()
    for n in range(cycles):
        wait = start + n * PERIOD_NS - time.monotonic_ns()
        if wait > 0:
            time.sleep(wait * 1e-9)
        bus.write_frames([Frame(0x300 + k, n.to_bytes(8, "big")) for k in range(3)] + [Frame(0x80, bytes([n % 240]))])
        answers += len(bus.read_frames(0))
    while answers < cycles * DRIVE_BURST and (frames := bus.read_frames(2)):
        answers += len(frames)
    pipe.send(("host", answers, "answers in", round((time.monotonic_ns() - start) * 1e-9, 3), "s"))
    bus.shutdown()


def drives(channel: str, cycles: int, pipe) -> None:
    bus = VirtualCanBus(channel)
    pipe.send("joined")
    cycle = 0
    while cycle < cycles:
        for frame in bus.read_frames(5):
            if frame.can_id == 0x80:
                bus.write_frames([Frame(0x180 + k, cycle.to_bytes(8, "big")) for k in range(DRIVE_BURST)])
                cycle += 1
    pipe.send(("drives", cycle))
    bus.shutdown()


def listener(channel: str, cycles: int, pipe) -> None:
    bus = VirtualCanBus(channel)
    pipe.send("joined")
    count, out_of_order, last = 0, 0, {}
    while count < cycles * (HOST_BURST + DRIVE_BURST) and (frames := bus.read_frames(5)):
        count += len(frames)
        for frame in frames:
            if len(frame.data) == 8:
                n = int.from_bytes(frame.data, "big")
                out_of_order += n != last.get(frame.can_id, -1) + 1
                last[frame.can_id] = n
    pipe.send(("listener", count, "frames,", out_of_order, "out of order"))
    bus.shutdown()


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
    for _, pipe in reversed(started):
        print(*pipe.recv())
    for process, _ in started:
        process.join()
    server.terminate()
    used_s = ours.recv()
    server.join()
    print(f"hub: {100 * used_s / seconds:.1f} % of one core")


if __name__ == "__main__":
    mp.set_start_method("spawn")
    main()
