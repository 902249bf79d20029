"""LSS of an emulated drive, message by message (CiA 305)."""

import pytest

from protocols import lss, nmt
from protocols.frames import Frame
from protocols.lss import Identity, Mode, Scan, Service

IDENTITY = Identity(0, 0x4152_4D52, 0x0001_0000, 5)


def ask(bench, *frames: Frame) -> list[bytes]:
    """What a drive answers on the LSS identifier."""
    return [f.data for frame in frames for f in bench.send(frame.can_id, frame.data) if f.can_id == lss.RESPONSE]


def reply(service: Service, *parts: int) -> bytes:
    return bytes((service, *parts)).ljust(8, b"\0")


@pytest.fixture
def selected(bench):
    """In configuration."""
    assert ask(bench, *lss.select(IDENTITY)) == [reply(Service.SWITCHED)]
    return bench


@pytest.mark.parametrize("part", range(4))
def test_selection_needs_the_whole_address(bench, part: int) -> None:
    wrong = IDENTITY._replace(**{IDENTITY._fields[part]: 99})
    assert ask(bench, *lss.select(wrong)) == []
    assert ask(bench, *lss.select(IDENTITY)[part:]) == ([] if part else [reply(Service.SWITCHED)])
    assert ask(bench, *lss.select(IDENTITY)) == [reply(Service.SWITCHED)]


def test_only_configuration_configures(bench) -> None:
    assert ask(bench, lss.message(Service.NODE_ID, 9), lss.message(Service.INQUIRE_NODE_ID)) == []
    ask(bench, lss.message(Service.SWITCH_GLOBAL, Mode.CONFIGURATION))
    assert ask(bench, lss.message(Service.INQUIRE_NODE_ID)) == [reply(Service.INQUIRE_NODE_ID, 5)]
    ask(bench, lss.message(Service.SWITCH_GLOBAL, 7))  # no such state
    assert ask(bench, lss.message(Service.INQUIRE_NODE_ID)) == [reply(Service.INQUIRE_NODE_ID, 5)]
    ask(bench, lss.message(Service.SWITCH_GLOBAL, Mode.WAITING))
    assert ask(bench, lss.message(Service.INQUIRE_NODE_ID)) == []


def test_address_is_told(selected) -> None:
    for i, value in enumerate(IDENTITY):
        (answer,) = ask(selected, lss.message(Service(Service.INQUIRE_VENDOR + i)))
        assert answer[0] == Service.INQUIRE_VENDOR + i and lss.value_of(answer) == value


@pytest.mark.parametrize(("node", "error"), [(1, 0), (127, 0), (255, 0), (0, 1), (128, 1)])
def test_node_ids(selected, node: int, error: int) -> None:
    assert ask(selected, lss.message(Service.NODE_ID, node)) == [reply(Service.NODE_ID, error)]


def test_a_node_id_counts_from_the_next_reset_of_communication(selected) -> None:
    ask(selected, lss.message(Service.NODE_ID, 9))
    assert selected.read_int(0x1000)  # still node 5
    assert selected.nmt(nmt.Command.RESET_COMMUNICATION) == [Frame(0x709, b"\0")]
    selected.node = 9
    assert selected.read_int(0x1014) == 0x89 and selected.read_int(0x1200, 1) == 0x609
    assert selected.read_int(0x1018, 4) == 5  # a serial number stays
    selected.nmt(nmt.Command.START)
    assert [f.can_id for f in selected.sync()] == [0x189]


def test_power_off_forgets_what_was_not_stored(selected) -> None:
    ask(selected, lss.message(Service.NODE_ID, 9))
    assert selected.drive.start(selected.t_ns) == [Frame(0x705, b"\0")]
    ask(selected, *lss.select(IDENTITY), lss.message(Service.NODE_ID, 9))
    assert ask(selected, lss.message(Service.STORE)) == [reply(Service.STORE, 0)]
    assert selected.drive.start(selected.t_ns) == [Frame(0x709, b"\0")]


def test_a_drive_without_node_id(make_bench, monkeypatch) -> None:
    monkeypatch.setattr(make_bench, "node", 255)
    bench = make_bench(serial=77)
    assert bench.log == []  # no boot-up
    assert bench.nmt(nmt.Command.RESET_NODE) == [] == bench.sync(3)
    assert ask(bench, lss.message(Service.IDENTIFY_UNCONFIGURED)) == [reply(Service.UNCONFIGURED_IDENTIFIED)]
    ask(bench, lss.message(Service.SWITCH_GLOBAL, Mode.CONFIGURATION))
    ask(bench, lss.message(Service.NODE_ID, 7))
    sent = bench.send(lss.REQUEST, lss.message(Service.SWITCH_GLOBAL, Mode.WAITING).data)
    assert sent == [Frame(0x707, b"\0")]
    bench.node = 7
    assert bench.read_int(0x1018, 4) == 77
    assert ask(bench, lss.message(Service.IDENTIFY_UNCONFIGURED)) == []


@pytest.mark.parametrize(("low", "high", "answered"), [(5, 5, True), (0, 9, True), (6, 9, False), (0, 4, False)])
def test_identification_by_ranges(bench, low: int, high: int, answered: bool) -> None:
    questions = [
        lss.number(Service.IDENTIFY_VENDOR, IDENTITY.vendor),
        lss.number(Service.IDENTIFY_PRODUCT, IDENTITY.product),
        lss.number(Service.IDENTIFY_REVISION_LOW, 0),
        lss.number(Service.IDENTIFY_REVISION_HIGH, 2**32 - 1),
        lss.number(Service.IDENTIFY_SERIAL_LOW, low),
        lss.number(Service.IDENTIFY_SERIAL_HIGH, high),
    ]
    assert ask(bench, *questions) == [reply(Service.IDENTIFIED)] * answered
    assert ask(bench, questions[-1]) == []


def test_fast_scan_finds_each_of_several(make_bench, monkeypatch) -> None:
    monkeypatch.setattr(make_bench, "node", 255)
    serials = {0, 1, 0x8000_0000, 0xFFFF_FFFF, 0x1234_5678}
    benches = [make_bench(serial=s) for s in serials]

    def heard(scan: Scan) -> bool:
        return any([bool(ask(b, scan.encode())) for b in benches])

    found = set()
    while heard(Scan(0, lss.ANY, 0, 0)):
        identity = []
        for part in range(4):
            number = 0
            for bit in range(31, -1, -1):
                if not heard(Scan(number, bit, part, part)):
                    number |= 1 << bit
            assert heard(Scan(number, 0, part, (part + 1) % 4))
            identity.append(number)
        found.add(identity[3])
        assert tuple(identity[:3]) == IDENTITY[:3]
        for bench in benches:  # exactly one is in configuration now
            ask(bench, lss.message(Service.NODE_ID, len(found)))
            ask(bench, lss.message(Service.SWITCH_GLOBAL, Mode.WAITING))
    assert found == serials
    assert sorted(b.drive.device.node_id for b in benches) == [1, 2, 3, 4, 5]


@pytest.mark.parametrize(("table", "index", "error"), [(0, 2, 0), (0, 8, 0), (0, 5, 1), (0, 9, 1), (1, 0, 1)])
def test_bit_rates(selected, table: int, index: int, error: int) -> None:
    assert ask(selected, lss.message(Service.BIT_TIMING, table, index)) == [reply(Service.BIT_TIMING, error)]


def test_a_drive_at_another_bit_rate_is_not_there(selected) -> None:
    ask(selected, lss.message(Service.BIT_TIMING, 0, 3))  # 250 kbit/s
    assert ask(selected, lss.message(Service.ACTIVATE_BIT_TIMING, 10)) == []
    selected.wait(50)
    selected.nmt(nmt.Command.START)
    assert selected.sync(3) == [] == ask(selected, *lss.select(IDENTITY))


def test_power_off_ends_a_change_of_bit_rate(selected) -> None:
    ask(selected, lss.message(Service.BIT_TIMING, 0, 3), lss.message(Service.ACTIVATE_BIT_TIMING, 100))
    assert selected.drive.start(selected.t_ns) == [Frame(0x705, b"\0")]
    selected.wait(500)
    assert ask(selected, *lss.select(IDENTITY)) == [reply(Service.SWITCHED)]
    ask(selected, lss.message(Service.BIT_TIMING, 0, 3), lss.message(Service.STORE))
    assert selected.drive.start(selected.t_ns) == []  # at 250 kbit/s on a bus of 1 Mbit/s


def test_activating_the_same_bit_rate_takes_two_delays(selected) -> None:
    ask(selected, lss.message(Service.ACTIVATE_BIT_TIMING, 10))
    selected.wait(19)
    assert ask(selected, *lss.select(IDENTITY)) == []
    selected.wait(1)
    assert ask(selected, *lss.select(IDENTITY)) == [reply(Service.SWITCHED)]


@pytest.mark.parametrize("data", [b"", b"\4", bytes(7), bytes(8), b"\xff" * 8, b"\x51" + b"\xff" * 7])
def test_garbage(bench, data: bytes) -> None:
    assert bench.send(lss.REQUEST, data) == []
