"""Cost per frame of everything between the text of a pipe and the file: `python tests/benchmarks/recorder.py`.

Twenty seconds of the TX40 rig: 14 frames a cycle at 1 kHz. CPU time of this process, writer included.
"""

import struct
import tempfile
import time
from pathlib import Path

from daq.decode import Decoder
from daq.integrity import Integrity
from daq.recorder import Recorder
from protocols import nmt
from protocols.candump import format_frame, parse_line
from protocols.frames import Frame
from protocols.recording import read_recording
from protocols.rig import load_rig

CYCLES = 20_000
MS = 1_000_000


def main() -> None:
    rig, robot = load_rig("tx40-rig")
    buses = [b.name for b in rig.bus]
    batches: list[tuple[str, list[tuple[int, Frame]]]] = []
    for n in range(1, CYCLES + 1):
        for bus in buses:
            nodes = [d.node for d in rig.drive if d.bus == bus]
            frames = [Frame(nmt.rpdo_id(2, k), bytes(6)) for k in nodes] + [nmt.sync((n - 1) % 240 + 1)]
            frames += [Frame(nmt.tpdo_id(1, k), struct.pack("<ihH", n * k, n % 1000, n % 65536)) for k in nodes]
            batches.append((bus, [(n * MS, f) for f in frames]))
    count = sum(len(frames) for _, frames in batches)
    lines = [format_frame(t, bus, f) for bus, frames in batches for t, f in frames]

    def report(what: str, begin: float) -> None:
        print(f"{what:28} {(time.process_time() - begin) / count * 1e6:6.2f} us per frame")

    begin = time.process_time()
    for line in lines:
        parse_line(line)
    report("candump text to frames", begin)

    decoder = Decoder(rig, robot, Integrity.of(buses, robot.joint_names))
    begin = time.process_time()
    for bus, frames in batches:
        decoder.feed(bus, frames)
    report("frames to cycles", begin)

    with tempfile.TemporaryDirectory() as folder:
        recorder = Recorder(Path(folder) / "run.mcap", rig, robot)
        begin = time.process_time()
        for bus, frames in batches:
            recorder.frames(bus, frames)
        summary = recorder.close()
        report("frames to file, decoded too", begin)
        print(f"{summary.verdict}, {summary.path.stat().st_size / count:.1f} bytes per frame on disk")
        begin = time.process_time()
        rows = len(read_recording(summary.path).t_s)
        print(f"{'file to signals':28} {(time.process_time() - begin) / rows * 1e6:6.2f} us per cycle")


if __name__ == "__main__":
    main()
