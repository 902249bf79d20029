"""The recorder beside the message-at-a-time writer of the mcap package."""

import io
import tempfile
from collections.abc import Iterator
from pathlib import Path

from mcap.writer import CompressionType, Writer

from daq.recorder import Recorder
from protocols import nmt, topics
from protocols.checks import Figure
from protocols.clock import RealClock
from protocols.frames import Frame
from protocols.rig import load_rig

CYCLES = 3_000
PERIOD_NS = 1_000_000


def figures() -> Iterator[Figure]:
    """Time per frame of a six-axis rig: decode, count, encode, compress, write; the peer only encodes and writes."""
    rig, robot = load_rig("tx40-rig")
    nodes = {b.name: [d.node for d in rig.drive if d.bus == b.name] for b in rig.bus}
    traffic = [(n, bus, _cycle(n, nodes[bus])) for n in range(1, CYCLES + 1) for bus in nodes]
    count = sum(len(frames) for _, _, frames in traffic)
    clock = RealClock()
    with tempfile.TemporaryDirectory() as folder:
        begin = clock.now_ns()
        recorder = Recorder(Path(folder) / "bench.mcap", rig, robot)
        for n, bus, frames in traffic:
            recorder.frames(bus, [(n * PERIOD_NS, f) for f in frames])
        recorder.close()
        ours_us = (clock.now_ns() - begin) * 1e-3 / count
    begin = clock.now_ns()
    _with_package(traffic)
    theirs_us = (clock.now_ns() - begin) * 1e-3 / count
    yield Figure("recorder", ours_us, "us/frame", "mcap package, frames only", theirs_us, theirs_us / ours_us)


def _cycle(n: int, nodes: list[int]) -> list[Frame]:
    """Targets, SYNC and answers of one cycle on one bus."""
    targets = [Frame(nmt.rpdo_id(2, node), n.to_bytes(6, "little")) for node in nodes]
    answers = [
        Frame(nmt.tpdo_id(1, node), n.to_bytes(6, "little") + (n & 0xFFFF).to_bytes(2, "little")) for node in nodes
    ]
    return [*targets, nmt.sync((n - 1) % 240 + 1), *answers]


def _with_package(traffic: list[tuple[int, str, list[Frame]]]) -> None:
    writer = Writer(io.BytesIO(), chunk_size=256 * 1024, compression=CompressionType.ZSTD)
    writer.start(topics.PROFILE)
    schema = writer.register_schema(topics.FRAME.name, topics.SCHEMA_ENCODING, topics.FRAME.text.encode())
    channels: dict[str, int] = {}
    for n, bus, frames in traffic:
        if bus not in channels:
            channels[bus] = writer.register_channel(f"/{bus}/frames", topics.ENCODING, schema)
        t_ns = n * PERIOD_NS
        for frame in frames:
            values = {
                **topics.stamp(t_ns),
                "header.frame_id": bus,
                "id": frame.can_id,
                "is_rtr": False,
                "is_extended": False,
                "is_error": False,
                "dlc": len(frame.data),
                "data": frame.data.ljust(8, b"\0"),
            }
            writer.add_message(channels[bus], t_ns, topics.FRAME.encode(values), t_ns)
    writer.finish()
