"""The emulated bus against schedules worked out by hand and the response-time analysis of the literature."""

from itertools import pairwise, product
from math import ceil, lcm

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.disturbance import NEVER_NS, Disturbance, Kind
from emulator.wire import Heard, Wire
from protocols.errorframes import Class, State, decode
from protocols.frames import ERROR, EXTENDED, REMOTE, Frame, bit_length, bus_load, worst_case_bits

MBIT = 1_000_000
BIT_NS = 1000
MS = 1_000_000


def wire(*stations: str, bitrate: int | None = MBIT, **settings: object) -> Wire:
    made = Wire(bitrate, **settings)
    for number, station in enumerate((*stations, "listener"), 1):
        made.join(0, station, number)
    return made


def run(bus: Wire, offers: list[tuple[int, str, Frame]], until_ns: int = 10**12) -> list[Heard]:
    heard = []
    for t_ns, station, frame in sorted(offers, key=lambda o: o[0]):
        heard += bus.advance(t_ns - 1)
        bus.offer(t_ns, station, frame)
    return heard + bus.advance(until_ns)


def bits(frame: Frame) -> int:
    """Length without the intermission: when the frame is heard."""
    return bit_length(frame) - 3


# --- who is heard when ---


def test_one_frame_is_heard_at_its_end_and_the_next_after_three_bits_more() -> None:
    first, second = Frame(0x181, b"\x01"), Frame(0x182, b"\x02\x03")
    heard = run(wire("a"), [(500, "a", first), (600, "a", second)])
    begin_ns = 500 + bit_length(first) * BIT_NS
    assert heard == [
        Heard(500 + bits(first) * BIT_NS, first, ("a",)),
        Heard(begin_ns + bits(second) * BIT_NS, second, ("a",)),
    ]


def test_the_lowest_identifier_wins_whenever_the_bus_falls_idle() -> None:
    """0x300 is alone and starts; what queues meanwhile goes by identifier, a late 0x080 before all that wait."""
    long, feedback, sync = Frame(0x300, bytes(8)), [Frame(0x180 + n, bytes(8)) for n in (1, 2, 3)], Frame(0x80, b"\1")
    offers = [
        (0, "host", long),
        *((10 + n, f"drive{n}", f) for n, f in zip((3, 2, 1), reversed(feedback), strict=True)),
    ]
    offers.append((bit_length(long) * BIT_NS + 1, "sync", sync))
    heard = run(wire("host", "sync", "drive1", "drive2", "drive3"), offers)
    assert [h.frame for h in heard] == [long, feedback[0], sync, feedback[1], feedback[2]]
    ends = [0]
    for h in heard:
        assert h.t_ns == ends[-1] + bits(h.frame) * BIT_NS
        ends.append(ends[-1] + bit_length(h.frame) * BIT_NS)


def test_a_controller_sends_in_the_order_it_was_given() -> None:
    """Targets first, SYNC after them, although SYNC has the lowest identifier: that is what a host's queue does."""
    burst = [Frame(0x301, bytes(6)), Frame(0x302, bytes(6)), Frame(0x80, b"\1")]
    heard = run(wire("host", "drive"), [(0, "host", f) for f in burst] + [(1, "drive", Frame(0x700, b"\5"))])
    assert [h.frame.can_id for h in heard] == [0x301, 0x302, 0x80, 0x700]


@pytest.mark.parametrize(
    "order",
    [
        (0x100, 0x101),
        (0x123, 0x123 << 18 | EXTENDED),  # the same 11 bits: SRR and IDE are recessive
        (0x123, 0x123 | REMOTE),  # data before remote
        ((0x123 << 18) + 1 | EXTENDED, 0x124),
        (5 | EXTENDED, 5 | EXTENDED | REMOTE),
    ],
)
def test_arbitration_of_all_formats(order: tuple[int, int]) -> None:
    frames = [Frame(can_id) for can_id in order]
    heard = run(wire("a", "b", "c"), [(0, "c", Frame(0)), (1, "a", frames[1]), (1, "b", frames[0])])
    assert [h.frame for h in heard[1:]] == frames


@given(st.lists(st.tuples(st.integers(0, 5 * MS), st.integers(0, 3), st.integers(0, 0x7FF)), max_size=40))
def test_nothing_is_lost_overlaps_or_is_idle_without_need(raw: list[tuple[int, int, int]]) -> None:
    """Each frame once, in each station's order; back to back while anything waits."""
    offers = [(t, "abcd"[s], Frame(s << 9 | i & 0x1FF, bytes([n]))) for n, (t, s, i) in enumerate(sorted(raw))]
    heard = run(wire("a", "b", "c", "d"), offers)
    assert sorted(h.frame.data for h in heard) == sorted(f.data for _, _, f in offers)
    for station in "abcd":
        assert [h.frame for h in heard if h.senders == (station,)] == [f for _, s, f in offers if s == station]
    offered_ns = {f.data: t for t, _, f in offers}
    free_ns = 0
    for k, h in enumerate(heard):
        begin_ns = h.t_ns - bits(h.frame) * BIT_NS
        assert begin_ns == max(free_ns, min(offered_ns[later.frame.data] for later in heard[k:]))
        free_ns = h.t_ns + 3 * BIT_NS


def test_the_order_in_which_time_is_asked_for_changes_nothing() -> None:
    offers = [(n * 37_000, "ab"[n % 2], Frame(0x180 + n % 7, bytes(n % 9))) for n in range(60)]
    at_once = run(wire("a", "b"), offers)
    slowly, bus = [], wire("a", "b")
    for t_ns, station, frame in offers:
        bus.offer(t_ns, station, frame)
        slowly += bus.advance(t_ns)
        while bus.next_ns < t_ns + 37_000:
            slowly += bus.advance(bus.next_ns)
    assert slowly + bus.advance(10**12) == at_once
    assert bus.next_ns == NEVER_NS


# --- how long it takes: Davis, Burns, Bril, Lukkien 2007, "Controller Area Network (CAN) schedulability analysis" ---


def response_bounds(periods: list[int], costs: list[int]) -> list[int]:
    """Worst-case response times, section 4, eqs. (3) to (9), in the order of priority."""
    bounds = []
    for m, cost in enumerate(costs):
        blocking = max(costs[m + 1 :], default=0)

        def busy(length: int, m: int = m, blocking: int = blocking) -> int:
            return blocking + sum(ceil(length / periods[k]) * costs[k] for k in range(m + 1))

        length = cost
        while busy(length) != length:
            length = busy(length)
        worst = 0
        for q in range(ceil(length / periods[m])):
            w = blocking + q * cost
            while (again := blocking + q * cost + sum(ceil((w + 1) / periods[k]) * costs[k] for k in range(m))) != w:
                w = again
            worst = max(worst, w - q * periods[m] + cost)
        bounds.append(worst)
    return bounds


def observed(periods: list[int], frames: list[Frame], phases: list[int], horizon: int) -> list[int]:
    """Longest response of each message, intermission included [ns]."""
    names = [str(k) for k in range(len(frames))]
    offers = [
        (t, name, frame)
        for name, frame, period, phase in zip(names, frames, periods, phases, strict=True)
        for t in range(phase, horizon, period)
    ]
    heard = run(wire(*names), offers)
    worst = [0] * len(frames)
    for k, name in enumerate(names):
        ends = [h.t_ns + 3 * BIT_NS for h in heard if h.senders == (name,)]
        worst[k] = max(end - begin for end, begin in zip(ends, range(phases[k], horizon, periods[k]), strict=True))
    return worst


FRAMES = [Frame(0x181, b"\x55" * 7), Frame(0x182, b"\x55" * 7), Frame(0x183, b"\x55" * 7)]


def test_the_example_that_refuted_the_older_analysis() -> None:
    """Davis et al., table 2: A, B, C of 1 ms each, periods 2.5, 3.5, 3.5 ms: 2.0, 3.0 and 3.5 ms, C's from its second
    instance. Here a frame of n bits stands for 1 ms."""
    n = bit_length(FRAMES[0])
    padded = [
        f for f in (Frame(i, bytes([k]) * 7) for i in range(0x100, 0x200) for k in range(256)) if bit_length(f) == n
    ]
    frames = [padded[0], padded[len(padded) // 2], padded[-1]]
    assert frames[0].can_id < frames[1].can_id < frames[2].can_id
    cost = n * BIT_NS
    periods = [cost * 5 // 2, cost * 7 // 2, cost * 7 // 2]
    assert [b / cost for b in response_bounds(periods, [cost] * 3)] == [2.0, 3.0, 3.5]
    together = observed(periods, frames, [0, 0, 0], 40 * cost)
    assert [t / cost for t in together] == pytest.approx([1.5, 2.0, 3.5], abs=1e-3)
    blocked = observed(periods, frames, [1, 1, 0], 40 * cost)  # the lowest starts a nanosecond before the others
    assert [t / cost for t in blocked[:2]] == pytest.approx([2.0, 3.0], abs=1e-3)


@settings(max_examples=25, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from([1, 2, 4, 5]), st.integers(0, 8), st.integers(0, 0xFF), st.integers(0, MS)),
        min_size=2,
        max_size=7,
    )
)
def test_no_response_ever_exceeds_the_bound(raw: list[tuple[int, int, int, int]]) -> None:
    frames = [Frame(0x100 + k, bytes([fill]) * size) for k, (_, size, fill, _) in enumerate(raw)]
    periods = [ms * MS for ms, _, _, _ in raw]
    costs = [bit_length(f) * BIT_NS for f in frames]
    bounds = response_bounds(periods, costs)
    seen = observed(periods, frames, [phase for *_, phase in raw], 2 * lcm(*periods))
    assert all(s <= b for s, b in zip(seen, bounds, strict=True))


def test_every_bound_is_reached() -> None:
    """Released together, a nanosecond after the longest frame of lower priority has begun: the critical instant."""
    frames = [Frame(0x100 + k, bytes([k * 37]) * size) for k, size in enumerate((8, 2, 8, 1, 6, 8, 7))]
    periods = [ms * MS for ms in (1, 2, 2, 4, 5, 5, 10)]
    costs = [bit_length(f) * BIT_NS for f in frames]
    for m, bound in enumerate(response_bounds(periods, costs)):
        lower = costs[m + 1 :]
        phases = [1] * len(frames)
        if lower:
            phases[m + 1 + lower.index(max(lower))] = 0
        assert observed(periods, frames, phases, 40 * MS)[m] == bound - bool(lower)


def test_load_is_bus_arithmetic() -> None:
    """Three drives at 1 kHz both ways: 6 x 117 + 58 bits each millisecond by measurement, 875 at worst."""
    bus = wire("host", "drives")
    offers = []
    for n in range(1000):
        t_ns = n * MS
        offers += [(t_ns, "host", Frame(0x300 + k, (n * 7919 * k).to_bytes(8, "little"))) for k in (1, 2, 3)]
        offers += [(t_ns, "host", Frame(0x80, bytes([n % 240 + 1])))]
        offers += [(t_ns + 1, "drives", Frame(0x180 + k, (n * 104729 * k).to_bytes(8, "little"))) for k in (1, 2, 3)]
    before = bus.traffic
    run(bus, offers, 1000 * MS)
    load = bus.traffic.load_since(before, 1000 * MS)
    assert load == sum(bit_length(f) for _, _, f in offers) / MBIT
    assert load < bus_load([(8, 1000.0)] * 6 + [(1, 1000.0)], MBIT)
    assert bus.traffic.frames == 7000


def test_a_bus_that_is_too_full_falls_behind_for_ever_in_low_priority_alone() -> None:
    """Six drives both ways on one bus, 1 kHz: 147 %. The targets are late by more every cycle, SYNC is not."""
    bus = wire("host", *(f"drive{k}" for k in range(1, 7)))
    offers = []
    for n in range(200):
        offers.append((n * MS, "host", Frame(0x80, bytes([n % 240 + 1]))))
        offers += [(n * MS, f"drive{k}", Frame(0x180 + k, bytes(8))) for k in range(1, 7)]
        offers += [(n * MS + 1, "host", Frame(0x300 + k, bytes(8))) for k in range(1, 7)]
    heard = run(bus, offers, 200 * MS)
    assert bus.traffic.load_since(wire().traffic, 200 * MS) == pytest.approx(1, abs=1e-3)
    arrived = [h.frame.can_id for h in heard]
    assert sum(i >= 0x300 for i in arrived) < 0.45 * 1200


def test_a_full_queue_loses_and_says_so() -> None:
    bus = wire("a", queue_frames=10)
    told = [bus.offer(0, "a", Frame(0x181, bytes([n]))) for n in range(12)]
    assert told[:10] == [None] * 10
    assert told[10] is not None
    assert told[10].to == "a"
    assert decode(told[10].frame).text == "transmit buffer overflow: frames are lost"
    assert len(bus.advance(10 * MS)) == 10
    assert bus.traffic.lost == 2


@pytest.mark.parametrize("bitrate", [1_000_000, 500_000, 250_000, 83_333])
def test_bit_rate_scales_everything(bitrate: int) -> None:
    frame = Frame(0x181, bytes(8))
    [heard] = run(wire("a", bitrate=bitrate), [(0, "a", frame)])
    assert heard.t_ns == bits(frame) * 1_000_000_000 // bitrate


def test_an_ideal_bus_takes_no_time() -> None:
    offers = [(n * 10, "ab"[n % 2], Frame(0x100 + n)) for n in range(20)]
    bus = wire("a", "b", bitrate=None)
    assert [(h.t_ns, h.frame) for h in run(bus, offers)] == [(t, f) for t, _, f in offers]
    assert bus.traffic.busy_ns == 0


# --- errors: counters after ISO 11898-1, 10.13 ---


def corrupting(count: int, **more: object) -> Disturbance:
    return Disturbance(Kind.CORRUPT, "can0", left=count, **more)


def test_a_bit_error_costs_an_error_frame_and_the_frame_goes_again() -> None:
    frame = Frame(0x181, bytes(8))
    bus = wire("a", "b", disturbances=[corrupting(1)])
    [heard] = run(bus, [(0, "a", frame)])
    attempt = heard.t_ns // BIT_NS - bits(frame)  # bits until the second one began
    assert 14 + 23 <= attempt <= bit_length(frame) - 11 + 23
    assert (bus.state("a").tec, bus.state("b").rec, bus.state("listener").rec) == (7, 0, 0)  # +8 -1, +1 -1
    assert bus.traffic[:2] == (1, 1)
    assert bus.traffic.busy_ns == (attempt + bit_length(frame)) * BIT_NS


def test_the_way_down_to_bus_off_and_back() -> None:
    """8 errors more each time: warning at 96 after 12, passive at 128 after 16, off at 256 after 32."""
    bus = wire("a", "b", disturbances=[corrupting(32)], restart_ns=100 * MS)
    bus.offer(0, "a", Frame(0x181, bytes(8)))
    heard = bus.advance(50 * MS)
    told = [decode(h.frame) for h in heard if h.to == "a"]
    assert [(r.state, r.tec) for r in told] == [(State.WARNING, 96), (State.PASSIVE, 128), (State.BUS_OFF, 255)]
    assert all(r.station == 1 for r in told)
    assert not [h for h in heard if not h.frame.can_id & ERROR]
    assert not bus.hears("a")
    assert bus.hears("b")
    assert bus.traffic.errors == 32
    assert bus.traffic.lost == 1
    off_ns = heard[-1].t_ns
    bus.offer(51 * MS, "a", Frame(0x182))  # nobody takes it
    bus.offer(51 * MS, "b", Frame(0x183))
    later = bus.advance(off_ns + 100 * MS)
    assert [h.frame for h in later if h.to is None] == [Frame(0x183)]
    back = later[-1]
    assert (back.t_ns, back.to) == (off_ns + 100 * MS, "a")
    assert decode(back.frame).classes & Class.RESTARTED
    assert bus.state("a").tec == 0
    assert bus.hears("a")


def test_receivers_go_passive_but_never_off() -> None:
    bus = wire("a", "b", disturbances=[corrupting(200)], restart_ns=1)
    told = []
    for n in range(10):
        bus.offer(n * 100 * MS, "a", Frame(0x181, bytes(8)))
        told += [decode(h.frame) for h in bus.advance((n + 1) * 100 * MS) if h.to == "b"]
    states = [r.state for r in told]
    assert states[:2] == [State.WARNING, State.PASSIVE]
    assert State.BUS_OFF not in states
    assert bus.state("b").rec < 128  # what goes through heals
    assert states[-1] is State.WARNING


def test_a_passive_controller_gives_way_for_eight_bits() -> None:
    """The 16th error makes it passive: after that one and the two to come, a lower priority passes it by."""
    bus = wire("a", "b", disturbances=[corrupting(18, can_id=0x101, mask=0x7FF)])
    for n in range(3):
        bus.offer(0, "a", Frame(0x101, bytes([n])))
        bus.offer(0, "b", Frame(0x700, bytes([n])))
    order = [h.frame.can_id for h in bus.advance(100 * MS) if h.to is None]
    assert order == [0x700] * 3 + [0x101] * 3
    healthy = wire("a", "b")
    for n in range(3):
        healthy.offer(0, "a", Frame(0x101, bytes([n])))
        healthy.offer(0, "b", Frame(0x700, bytes([n])))
    assert [h.frame.can_id for h in healthy.advance(100 * MS)] == [0x101] * 3 + [0x700] * 3


def test_alone_on_a_bus_a_controller_goes_passive_and_waits_for_somebody() -> None:
    bus = Wire(MBIT)
    bus.join(0, "a")
    bus.offer(0, "a", Frame(0x701, b"\0"))
    told = [decode(h.frame) for h in bus.advance(1000 * MS)]
    assert "no acknowledgement: nobody else is on the bus" in told[0].text
    assert [r.state for r in told[1:]] == [State.WARNING, State.PASSIVE]
    assert bus.state("a").tec == 128
    assert bus.next_ns == NEVER_NS  # and not bus-off, however long it takes
    bus.join(1000 * MS, "b")
    [heard] = [h for h in bus.advance(2000 * MS) if h.to is None]
    assert heard.t_ns == 1000 * MS + bits(Frame(0x701, b"\0")) * BIT_NS
    assert bus.state("a").tec == 127


def test_two_stations_under_one_identifier() -> None:
    """The same bits go through as one frame; others collide until both are off the bus. Counters see each attempt."""
    same = wire("a", "b")
    heard = run(same, [(0, "listener", Frame(1)), (1, "a", Frame(0x705, b"\5")), (1, "b", Frame(0x705, b"\5"))])
    assert [h.frame.can_id for h in heard] == [1, 0x705]
    assert heard[1].senders == ("a", "b")
    differ = wire("a", "b", restart_ns=NEVER_NS)
    heard = run(differ, [(0, "listener", Frame(1)), (1, "a", Frame(0x705, b"\5")), (1, "b", Frame(0x705, b"\4"))])
    assert [h.frame for h in heard if h.to is None] == [Frame(1)]
    assert not differ.hears("a")
    assert not differ.hears("b")
    assert differ.hears("listener")


def test_a_station_that_leaves_takes_its_queue_along() -> None:
    bus = wire("a", "b")
    for n in range(3):
        bus.offer(0, "a", Frame(0x181, bytes([n])))
    bus.advance(10_000)
    bus.leave("a")
    assert [h.frame.data for h in bus.advance(10 * MS)] == [b"\0"]  # the one already on the wire


# --- what can be made to go wrong ---


def test_drop_is_heard_by_nobody_and_noticed_by_no_controller() -> None:
    bus = wire("a", disturbances=[Disturbance(Kind.DROP, "can0", left=3)])
    heard = run(bus, [(n * MS, "a", Frame(0x181, bytes([n]))) for n in range(10)])
    assert [h.frame.data[0] for h in heard] == list(range(3, 10))
    assert bus.traffic[:4] == (10, 0, 0, 3)
    assert bus.state("a").tec == 0


def test_duplicate_is_heard_twice_back_to_back() -> None:
    frame = Frame(0x181, b"\1")
    bus = wire("a", disturbances=[Disturbance(Kind.DUPLICATE, "can0", can_id=0x181, mask=0x7FF, left=1)])
    heard = run(bus, [(0, "a", Frame(0x182)), (0, "a", frame), (0, "a", frame)])
    assert [h.frame for h in heard] == [Frame(0x182), frame, frame, frame]
    gaps = [b.t_ns - a.t_ns for a, b in pairwise(heard[1:])]
    assert gaps == [bit_length(frame) * BIT_NS] * 2


def test_delay_holds_up_what_its_sender_has_behind_it_and_nobody_else() -> None:
    late = Disturbance(Kind.DELAY, "can0", can_id=0x181, mask=0x7FF, delay_ns=MS)
    bus = wire("a", "b", disturbances=[late])
    heard = run(bus, [(0, "a", Frame(0x181)), (0, "a", Frame(0x080)), (0, "b", Frame(0x7FF))])
    assert [h.frame.can_id for h in heard] == [0x7FF, 0x181, 0x080]
    assert heard[1].t_ns == MS + bits(Frame(0x181)) * BIT_NS


def test_jitter_spreads_sync_as_wide_as_told_and_repeats() -> None:
    def stamps(seed: int) -> list[int]:
        jitter = Disturbance(Kind.JITTER, "can0", can_id=0x80, mask=0x7FF, delay_ns=100_000)
        jitter.random.seed(seed)
        heard = run(wire("host", disturbances=[jitter]), [(n * MS, "host", Frame(0x80)) for n in range(2000)])
        return [h.t_ns - n * MS - bits(Frame(0x80)) * BIT_NS for n, h in enumerate(heard)]

    late = stamps(7)
    assert late == stamps(7)
    assert late != stamps(8)
    assert 0 <= min(late) < 2_000
    assert 98_000 < max(late) <= 100_000
    assert sum(late) / len(late) == pytest.approx(50_000, rel=0.05)


@pytest.mark.parametrize("node", [None, 2])
def test_bus_off_on_demand(node: int | None) -> None:
    off = Disturbance(Kind.BUS_OFF, "can0", node, begin_ns=5 * MS, restart_ns=20 * MS - 1)
    bus = wire("host", "drive")
    bus.disturb(off)
    heard = run(bus, [(n * MS, s, Frame(i, bytes([n]))) for n in range(40) for s, i in (("host", 1), ("drive", 2))])
    silent = {h.frame.data[0] for h in heard if h.frame.can_id == 2}
    assert silent == set(range(5)) | set(range(25, 40))
    speaking = {h.frame.data[0] for h in heard if h.frame.can_id == 1}
    assert speaking == (set(range(5)) | set(range(25, 40)) if node is None else set(range(40)))
    told = [(h.to, h.t_ns, decode(h.frame).state) for h in heard if h.to is not None]
    stations = ["host", "drive", "listener"] if node is None else ["drive"]
    moments = [(5 * MS, State.BUS_OFF), (25 * MS - 1, State.ACTIVE)]
    assert told == [(s, t, state) for (t, state), s in product(moments, stations)]


def test_worst_case_frames_fit_the_arithmetic() -> None:
    assert all(bit_length(Frame(0x181, bytes([k]) * 8)) <= worst_case_bits(8) for k in range(256))
