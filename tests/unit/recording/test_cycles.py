"""Frames to cycles: whatever is lost, late, doubled or restarted, a sample stands at the SYNC it answers, and the
counters say exactly what is missing."""

import struct

import numpy as np
import pytest

from daq.cycles import HOLD, Cycle
from daq.decode import Decoder
from daq.feedback import reader
from daq.integrity import Integrity
from protocols import emcy, nmt
from protocols.errors import ConfigError
from protocols.frames import ERROR, Frame

MS = 1_000_000


def decoder_of(wire) -> Decoder:
    return Decoder(wire.rig, wire.robot, Integrity.of([b.name for b in wire.rig.bus], wire.robot.joint_names))


def run(wire, batches) -> tuple[Decoder, list[Cycle]]:
    decoder = decoder_of(wire)
    for bus, frames in batches:
        decoder.feed(bus, frames)
    decoder.finish()
    return decoder, decoder.take_cycles()


def assert_on_grid(cycles: list[Cycle]) -> None:
    """Every sample that is there has the position its SYNC index says."""
    for cycle in cycles:
        for position, missing in zip(cycle.position, cycle.missing, strict=True):
            assert missing or position == cycle.sync


def texts(decoder: Decoder) -> list[str]:
    return [f"{e.source}: {e.text}" for e in decoder.take_events()]


def test_clean_traffic_is_lossless_and_complete(wire):
    decoder, cycles = run(wire, wire.cycles(1000))
    assert [c.sync for c in cycles] == list(range(1, 1001))
    assert not any(any(c.missing) for c in cycles)
    assert_on_grid(cycles)
    assert decoder.integrity.verdict().text == "LOSSLESS"
    assert decoder.integrity.bus["can0"].frames == 7000


@pytest.mark.parametrize("k", [1, 3, 17])
def test_dropping_k_tpdos_and_syncs_counts_exactly_k(wire, drop, k):
    rng = np.random.default_rng(k)
    batches = wire.cycles(800)
    cyclic = [
        (bus, t, f.can_id)
        for bus, frames in batches
        for t, f in frames
        if (f.can_id == nmt.SYNC or 0x180 < f.can_id < 0x200) and 20 * MS < t < 700 * MS
    ]
    gone = {cyclic[i] for i in rng.choice(len(cyclic), k, replace=False)}
    decoder, cycles = run(wire, drop(batches, lambda bus, t, f: (bus, t, f.can_id) in gone))
    verdict = decoder.integrity.verdict()
    assert verdict.text == f"GAPS({k})", verdict
    assert_on_grid(cycles)
    syncs = sum(can_id == nmt.SYNC for _, _, can_id in gone)
    assert sum(sum(c.missing) for c in cycles) == k - syncs  # a lost SYNC costs no sample
    assert sum(b.lost for b in decoder.integrity.bus.values()) == syncs


@pytest.mark.parametrize("outage", [1, 5, 100, 239, 240, 241, 480])
def test_total_outage_is_counted_over_turns_of_the_sync_counter(wire, drop, outage):
    """Nothing heard for `outage` cycles: SYNC counters alone cannot tell 240 lost from none."""
    batches = wire.cycles(300 + outage + 300)
    start = 300 * MS
    decoder, cycles = run(wire, drop(batches, lambda bus, t, f: start < t <= start + outage * MS))
    assert decoder.integrity.verdict().text == f"GAPS({outage * 8})"  # six TPDO1s and two SYNCs a cycle
    assert_on_grid(cycles)
    assert len(cycles) == 600


def test_tpdos_read_long_after_their_sync_stay_at_their_sync(wire):
    """The emulator stalls: eight SYNCs pass the hub before the drives answer any of them."""
    held, batches = [], []
    for bus, frames in wire.cycles(2000):
        syncs = [(t, f) for t, f in frames if f.can_id == nmt.SYNC]
        held += [(bus, [(t, f) for t, f in frames if f.can_id != nmt.SYNC])]
        batches.append((bus, syncs))
        if len(held) == 16:
            batches += held
            held = []
    decoder, cycles = run(wire, batches)
    assert_on_grid(cycles[HOLD:])
    assert decoder.integrity.verdict().text == "LOSSLESS"
    assert len(cycles) == 2000


def test_start_with_late_tpdos_is_corrected_within_the_hold(wire):
    """The first TPDO1 comes after the second SYNC; its true index shows when one arrives in time."""
    first, second = wire.cycle(), wire.cycle()
    late = [(bus, [x for x in frames if x[1].can_id == nmt.SYNC]) for bus, frames in first]
    late += [(bus, [x for x in frames if x[1].can_id == nmt.SYNC]) for bus, frames in second]
    late += [(bus, [x for x in frames if x[1].can_id != nmt.SYNC]) for bus, frames in first + second]
    decoder, cycles = run(wire, late + wire.cycles(500))
    assert_on_grid(cycles)
    assert len(cycles) == 502
    assert decoder.integrity.verdict().text == "LOSSLESS"


def test_duplicates_are_counted_and_ignored(wire):
    batches = [(bus, [x for pair in frames for x in (pair, pair)]) for bus, frames in wire.cycles(300)]
    decoder, cycles = run(wire, batches)
    assert len(cycles) == 300
    assert_on_grid(cycles)
    assert decoder.integrity.bus["can0"].duplicated == 300
    assert decoder.integrity.drive["joint4"].duplicated == 300
    assert decoder.integrity.verdict().text == "LOSSLESS"


def test_joining_a_running_rig(wire):
    """The recorder starts in mid-turn, and hears the two buses from different SYNCs on."""
    wire.cycles(239)
    batches = wire.cycles(400)
    decoder, cycles = run(wire, batches[1:])  # can0 misses its first SYNC, the 240th
    assert decoder.integrity.verdict().text == "LOSSLESS"
    base = cycles[0].position[3] - cycles[0].sync
    assert all(p - c.sync == base for c in cycles for p, m in zip(c.position, c.missing, strict=True) if not m)


def test_a_pause_of_the_host_breaks_the_grid_without_loss(wire):
    batches = wire.cycles(300)
    wire.t_ns += 2000 * MS
    batches += wire.cycles(300)
    decoder, cycles = run(wire, batches)
    assert decoder.integrity.verdict().text == "LOSSLESS"
    assert len(cycles) == 600
    assert cycles[300].sync - cycles[299].sync == pytest.approx(2001, abs=1)
    assert any("SYNC again after 2.00 s" in t for t in texts(decoder))


def test_a_restarted_host_and_reset_drives_are_no_loss(wire):
    batches = wire.cycles(300)
    batches.append(("can0", [(wire.t_ns + MS, nmt.command(nmt.Command.RESET_NODE))]))
    batches.append(("can1", [(wire.t_ns + MS, nmt.command(nmt.Command.RESET_NODE))]))
    wire.t_ns += 1500 * MS
    wire.counter, wire.consumed = 0, dict.fromkeys(wire.consumed, 0)
    batches += wire.cycles(300)
    decoder, cycles = run(wire, batches)
    assert decoder.integrity.verdict().text == "LOSSLESS"
    assert len(cycles) == 600


def test_a_drive_that_resets_while_others_run_leaves_a_counted_gap(wire, drop):
    before, away = wire.cycles(300), wire.cycles(200)
    wire.consumed["joint2"] = 0
    after = wire.cycles(300)
    away = drop(away, lambda bus, t, f: f.can_id == nmt.tpdo_id(1, 2))
    boot = [("can0", [(wire.t_ns - 310 * MS, nmt.heartbeat(2, nmt.State.INITIALISING))])]
    decoder, cycles = run(wire, before + away + boot + after)
    assert decoder.integrity.drive["joint2"].lost == 200
    assert decoder.integrity.verdict().text == "GAPS(200)"
    assert_on_grid(cycles)
    assert any(t == "joint2: boot-up of node 2 on can0" for t in texts(decoder))


def test_a_drive_that_dies_is_a_gap_to_the_end(wire, drop):
    batches = wire.cycles(2500)
    decoder, cycles = run(wire, drop(batches, lambda bus, t, f: f.can_id == 0x185 and t > 300 * MS))
    assert decoder.integrity.verdict().text == "GAPS(2200)"
    assert decoder.integrity.verdict().because == ("joint5: 2200 TPDO1 lost",)
    assert_on_grid(cycles)
    assert len(cycles) == 2500


def test_a_drive_that_misses_a_sync_is_found_and_put_right(wire, drop):
    """Others consume a SYNC that this drive did not get: its counter falls one behind for good."""
    batches = wire.cycles(500)
    missed = drop(wire.cycles(1), lambda bus, t, f: f.can_id == 0x181)
    wire.consumed["joint1"] -= 1
    decoder, cycles = run(wire, batches + missed + wire.cycles(2500))
    assert decoder.integrity.drive["joint1"].lost == 1
    assert any("joint1: the drive missed 1 SYNC" in t for t in texts(decoder))
    assert_on_grid(cycles[2100:])


def test_no_counters_cannot_be_verified(wire):
    strip = [(bus, [(t, Frame(f.can_id) if f.can_id == nmt.SYNC else f) for t, f in x]) for bus, x in wire.cycles(200)]
    decoder, cycles = run(wire, strip)
    assert len(cycles) == 200
    verdict = decoder.integrity.verdict()
    assert verdict.text == "UNVERIFIABLE"
    assert "can0: 200 SYNCs without counter" in verdict.because


def test_silence_cannot_be_verified(wire):
    decoder, cycles = run(wire, [])
    assert cycles == []
    assert decoder.integrity.verdict().text == "UNVERIFIABLE"
    assert "joint6: no TPDO1 seen" in decoder.integrity.verdict().because


def test_drops_reported_by_the_receiver_are_not_counted_twice(wire, drop):
    batches = wire.cycles(300)
    decoder, _ = run(wire, drop(batches, lambda bus, t, f: t == 100 * MS))  # 8 cyclic and 6 others
    decoder.integrity.bus["can0"].dropped = 7
    decoder.integrity.bus["can1"].dropped = 7
    assert decoder.integrity.verdict().text == "GAPS(14)"
    assert "can0: 7 frames dropped by the receiver" in decoder.integrity.verdict().because


def test_odd_frames_are_ignored_and_counted(wire):
    rng = np.random.default_rng(3)
    odd = [
        (t * MS, Frame(int(can_id), bytes(int(n))))
        for t, (can_id, n) in enumerate(
            zip(rng.choice([0x80, 0x181, 0x81, 0x701, 0x0], 50), rng.integers(2, 8, 50), strict=True)
        )
    ]
    decoder, cycles = run(wire, [("can0", odd), *wire.cycles(200)])
    assert len(cycles) == 200
    assert decoder.integrity.bus["can0"].malformed == sum(f.can_id in (0x80, 0x181, 0x81) for _, f in odd)


def test_events_in_the_rigs_words(wire):
    frames = [
        nmt.command(nmt.Command.START, 3),
        nmt.heartbeat(3, nmt.State.OPERATIONAL),
        emcy.encode(nmt.emcy_id(3), emcy.Emergency(0x2310, 0x03)),
        emcy.encode(nmt.emcy_id(3), emcy.Emergency(0, 0)),
        Frame(ERROR | 0x040, bytes(8)),
    ]
    decoder, _ = run(wire, [("can0", [(k * MS, f) for k, f in enumerate(frames)])])
    assert texts(decoder) == [
        "can0: NMT: start, node 3",
        "joint3: node 3 on can0 is operational",
        "joint3: node 3 on can0: emergency 0x2310, current on the output side (error register 0x03)",
        "joint3: node 3 on can0: no error any more",
        "can0: error frame: BUS OFF: the controller has left the bus",
    ]


def test_other_orders_in_the_pdo(wire):
    """The rig file decides where position, current and counter stand; other objects are passed over."""
    swapped = reader(["2001:0/16", "6078:0/16", "6064:0/32"])
    assert swapped.values(struct.pack("<Hhi", 7, -3, 70000)) == (70000, -3, 7)
    with pytest.raises(ConfigError, match=r"pdo.feedback has no current, .* Add 6078:0/16"):
        reader(["6064:0/32", "2001:0/16"])
    with pytest.raises(ConfigError, match="6064:0/16 must have 32 bits"):
        reader(["6064:0/16", "6078:0/16"])
    assert not reader(["6064:0/32", "6078:0/16"]).counted
