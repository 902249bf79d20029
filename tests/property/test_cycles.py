"""Cycles under arbitrary faults: drops, delays and duplicates never put a sample at the wrong SYNC, and every loss
is counted once."""

import struct
from operator import itemgetter

from hypothesis import given, settings
from hypothesis import strategies as st

from daq.decode import Decoder
from daq.integrity import Integrity
from protocols import nmt
from protocols.frames import Frame
from protocols.rig import load_rig

MS = 1_000_000
RIG, ROBOT = load_rig("tx40-rig")
NODES = {d.node: d.bus for d in RIG.drive}
CYCLES = 150
SETTLED = 8  # cycles at both ends without faults: enough to learn from, and to see the last loss

cyclic = st.tuples(st.integers(SETTLED, CYCLES - SETTLED), st.sampled_from(["can0", "can1", *NODES]))


@settings(max_examples=150, deadline=None)
@given(
    dropped=st.sets(cyclic, max_size=40),
    doubled=st.sets(cyclic, max_size=10),
    delays=st.lists(st.integers(0, 6), min_size=CYCLES - 2 * SETTLED, max_size=CYCLES - 2 * SETTLED),
)
def test_samples_stand_at_their_sync_and_losses_are_exact(dropped, doubled, delays):
    """`delays`: so many cycles after its SYNC each TPDO1 is read; CAN keeps the order of one sender."""
    lateness = [0] * (SETTLED + 1) + delays + [0] * SETTLED
    queue: list[tuple[int, int, str, Frame]] = []  # arrival, SYNC before TPDO1, bus, frame
    arrival = 0
    for n in range(1, CYCLES + 1):
        arrival = max(arrival, n + lateness[n])
        for bus in ("can0", "can1"):
            if (n, bus) not in dropped:
                queue += [(n, 0, bus, nmt.sync(n % 240))] * (1 + ((n, bus) in doubled))
        for node, bus in NODES.items():
            if (n, node) not in dropped:
                frame = Frame(nmt.tpdo_id(1, node), struct.pack("<ihH", n, node, n))
                queue += [(arrival, 1, bus, frame)] * (1 + ((n, node) in doubled))
    queue.sort(key=itemgetter(0, 1))

    decoder = Decoder(RIG, ROBOT, Integrity.of([b.name for b in RIG.bus], ROBOT.joint_names))
    for t, _, bus, frame in queue:
        decoder.feed(bus, [(t * MS, frame)])
    decoder.finish()

    for cycle in decoder.take_cycles():
        for position, absent in zip(cycle.position, cycle.missing, strict=True):
            assert absent or position == cycle.sync
    counters = decoder.integrity
    assert counters.verdict().text == (f"GAPS({len(dropped)})" if dropped else "LOSSLESS")
    duplicates = sum(b.duplicated for b in counters.bus.values()) + sum(d.duplicated for d in counters.drive.values())
    assert duplicates == len(doubled - dropped)


frames = st.tuples(
    st.sampled_from(["can0", "can1"]),
    st.one_of(st.sampled_from([0x0, 0x80, 0x81, 0x181, 0x184, 0x186, 0x701, 0x2000_0040]), st.integers(0, 2**32 - 1)),
    st.binary(max_size=8),
    st.integers(0, 3 * 10**9),
)


@settings(max_examples=150, deadline=None)
@given(st.lists(frames, max_size=120))
def test_no_frames_whatever_raise(some):
    decoder = Decoder(RIG, ROBOT, Integrity.of([b.name for b in RIG.bus], ROBOT.joint_names))
    t_ns = 0
    for bus, can_id, data, wait_ns in some:
        t_ns += wait_ns
        decoder.feed(bus, [(t_ns, Frame(can_id, data))])
    decoder.finish()
    syncs = [cycle.sync for cycle in decoder.take_cycles()]
    assert syncs == sorted(set(syncs))
    decoder.take_events()
    assert decoder.integrity.verdict().text
