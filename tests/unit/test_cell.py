"""The cell's register map and both of its ends, back to back and against a raw Modbus server that misbehaves."""

import json
import queue
import socket
import threading
from collections.abc import Iterator
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.client import ModbusTcpClient

from daq.cell import CellPoller
from emulator.cell import CellServer
from protocols import rig
from protocols.cell import (
    BY_NAME,
    INPUT_COUNT,
    LATCH,
    MAX_MOTORS,
    REGISTERS,
    CellState,
    Kind,
    TornReadError,
    decode,
    encode,
    to_json,
)
from protocols.clock import RealClock
from protocols.errors import PeerError
from protocols.topics import CellSample, Event

DEADLINE_S = 10.0
STATE = CellState((25.3, -4.0, 80.0, 31.1, 30.0, 29.9), 21.5, 325.4, False, True)


# --- the map ---


def test_each_table_is_contiguous_and_each_name_unique() -> None:
    for kind in Kind:
        addresses = [r.address for r in REGISTERS if r.kind is kind]
        assert addresses == list(range(len(addresses)))
    assert len(BY_NAME) == len(REGISTERS)


def test_words_on_the_wire() -> None:
    """By hand: 25.3 is 253 counts of 0.1 degC; -4.0 is -40, in two's complement 65536 - 40."""
    words, bits = encode(STATE, heartbeat=7, sequence=65537)
    assert words == [1, 7, 3254, 215, 253, 65496, 800, 311, 300, 299, *[0x8000] * 6, 1]
    assert len(words) == INPUT_COUNT
    assert bits == [False, True]


temperature = st.integers(-32767, 32767).map(lambda n: n / 10)


@given(
    st.builds(
        CellState,
        st.lists(temperature, max_size=MAX_MOTORS).map(tuple),
        temperature,
        st.integers(0, 65535).map(lambda n: n / 10),
        st.booleans(),
        st.booleans(),
    ),
    st.booleans(),
)
def test_round_trip(state: CellState, latched: bool) -> None:
    words, bits = encode(state, 3, 4)
    assert decode(words, bits, int(latched)) == (state, latched, 3, 4)


def test_values_beyond_a_register_are_clipped_and_never_read_as_not_fitted() -> None:
    words, bits = encode(CellState((-1e9, 1e9), 1e9, -5.0), 0, 0)
    state = decode(words, bits, 0).state
    assert state.motor_temperature_C == (-3276.7, 3276.7)
    assert state.supply_V == 0


def test_a_torn_read_is_refused() -> None:
    before, bits = encode(STATE, 1, 8)
    after, _ = encode(STATE, 2, 9)
    with pytest.raises(TornReadError, match="sequence 8 at the beginning of the read, 9 at its end"):
        decode(before[:5] + after[5:], bits, 0)


def test_thirteen_motors_do_not_fit() -> None:
    with pytest.raises(ValueError, match="13 motors, but the register map has room for 12"):
        CellState((20.0,) * 13)


def test_the_map_as_json_is_the_table() -> None:
    rows = json.loads(to_json())
    assert len(rows) == len(REGISTERS)
    assert rows[1] == {
        "name": "emergency_stop",
        "kind": "discrete input",
        "address": 0,
        "type": "bit",
        "scale": 1,
        "unit": "",
        "meaning": "1 while the button is pressed",
    }


# --- the server, with pymodbus' client ---


@pytest.fixture
def server() -> Iterator[CellServer]:
    server = CellServer(rig.Cell(port=0), STATE)
    server.start()
    yield server
    server.stop()


@pytest.fixture
def client(server: CellServer) -> Iterator[ModbusTcpClient]:
    with ModbusTcpClient("127.0.0.1", port=server.port, timeout=2, retries=0) as client:
        yield client


def registers(client: ModbusTcpClient) -> tuple[list[int], list[bool], int]:
    return (
        client.read_input_registers(0, count=INPUT_COUNT, device_id=1).registers,
        client.read_discrete_inputs(0, count=2, device_id=1).bits,
        client.read_holding_registers(LATCH, count=1, device_id=1).registers[0],
    )


def test_clients_read_what_the_rig_gave_last(server: CellServer, client: ModbusTcpClient) -> None:
    assert decode(*registers(client)).state == STATE
    newer = replace(STATE, ambient_temperature_C=22.0)
    server.update(newer)
    server.update(newer)
    while (reading := decode(*registers(client))).sequence < 3:
        pass
    assert reading.state == newer
    assert reading.heartbeat == 3


def test_the_latch_outlives_the_button_and_only_a_client_clears_it(server: CellServer, client: ModbusTcpClient) -> None:
    server.update(replace(STATE, emergency_stop=True))
    while not decode(*registers(client)).latched:
        pass
    refused = client.write_register(LATCH, 0, device_id=1)
    assert refused.exception_code == 3  # illegal data value: the button is still pressed
    server.update(STATE)
    while decode(*registers(client)).state.emergency_stop:
        pass
    assert decode(*registers(client)).latched
    assert server.latched
    assert client.write_register(LATCH, 1, device_id=1).exception_code == 3
    assert client.write_registers(LATCH, [7], device_id=1).exception_code == 3
    assert not client.write_register(LATCH, 0, device_id=1).isError()
    assert not decode(*registers(client)).latched
    assert not server.latched


def test_wrong_addresses_and_units_get_their_exceptions(client: ModbusTcpClient) -> None:
    assert client.read_input_registers(INPUT_COUNT, count=1, device_id=1).exception_code == 2
    assert client.read_input_registers(0, count=INPUT_COUNT + 1, device_id=1).exception_code == 2
    assert client.read_input_registers(0, count=1, device_id=9).exception_code == 11  # gateway target


def test_a_port_in_use_is_refused_by_start(server: CellServer) -> None:
    second = CellServer(rig.Cell(port=server.port))
    with pytest.raises(PeerError, match=f"127.0.0.1:{server.port} is in use by another process.*change .cell. port"):
        second.start()
    second.stop()


def test_an_address_that_is_not_ours_is_refused_by_start() -> None:
    second = CellServer(rig.Cell(host="192.0.2.1", port=0))
    with pytest.raises(PeerError, match=r"192.0.2.1:0 cannot be listened on: .*Change \[cell\] in the rig file"):
        second.start()
    second.stop()


def test_a_stopped_server_leaves_its_port_free() -> None:
    first = CellServer(rig.Cell(port=0))
    first.start()
    port = first.port
    with ModbusTcpClient("127.0.0.1", port=port, timeout=2) as client:
        client.read_input_registers(0, count=1, device_id=1)
        first.stop()
    again = CellServer(rig.Cell(port=port))
    again.start()
    again.stop()


# --- the poller ---


class Heard:
    """What a poller delivered."""

    def __init__(self, host: str, port: int) -> None:
        self._queue: queue.Queue[CellSample | Event] = queue.Queue()
        self.poller = CellPoller(rig.Cell(host=host, port=port, poll_Hz=50), RealClock(), self._queue.put)

    def __enter__(self) -> "Heard":
        self.poller.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.poller.stop()

    def event(self) -> str:
        """Text of the next event; samples before it are skipped."""
        while not isinstance(item := self._queue.get(timeout=DEADLINE_S), Event):
            pass
        assert item.source == "cell"
        return item.text

    def sample(self, *, stale: bool) -> CellSample:
        """The next sample that is stale, or is not."""
        while not (isinstance(item := self._queue.get(timeout=DEADLINE_S), CellSample) and item.stale is stale):
            pass
        return item


def test_the_poller_delivers_what_the_cell_measures(server: CellServer) -> None:
    with Heard("127.0.0.1", server.port) as heard:
        assert heard.event() == f"answers at 127.0.0.1:{server.port}"
        sample = heard.sample(stale=False)
        assert sample.motor_temperature_C == STATE.motor_temperature_C
        assert (sample.ambient_temperature_C, sample.supply_V) == (21.5, 325.4)
        assert (sample.emergency_stop, sample.brake_released) == (False, True)
        later = heard.sample(stale=False)
        assert later.t_ns > sample.t_ns > 0


def test_a_press_shorter_than_the_poll_is_not_missed(server: CellServer) -> None:
    with Heard("127.0.0.1", server.port) as heard:
        heard.sample(stale=False)
        server.update(replace(STATE, emergency_stop=True))
        server.update(STATE)
        while not heard.sample(stale=False).emergency_stop:
            pass


def test_a_cell_that_goes_and_comes_back() -> None:
    server = CellServer(rig.Cell(port=0), STATE)
    server.start()
    port = server.port
    with Heard("127.0.0.1", port) as heard:
        heard.sample(stale=False)
        server.stop()
        stale = heard.sample(stale=True)
        assert stale.motor_temperature_C == STATE.motor_temperature_C
        server = CellServer(rig.Cell(port=port), STATE)
        server.start()
        fresh = heard.sample(stale=False)
        assert fresh.t_ns - stale.t_ns < 1_000_000_000
    server.stop()


def test_events_tell_the_story_of_a_silent_cell() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with Heard("127.0.0.1", port) as heard:
        assert heard.event() == (
            f"no reading from 127.0.0.1:{port}: it does not accept a connection. Samples until it answers are stale."
        )
        server = CellServer(rig.Cell(port=port), STATE)
        server.start()
        assert heard.event().startswith("answers again after ")
    server.stop()


def test_a_cell_that_accepts_and_says_nothing_is_reported() -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        port = mute.getsockname()[1]
        with Heard("127.0.0.1", port) as heard:
            assert f"no reading from 127.0.0.1:{port}:" in heard.event()


def test_a_torn_read_is_an_event_and_no_sample() -> None:
    """A cell that is always between two updates: by hand, since pymodbus cannot be made to tear."""
    words = [*encode(STATE, 1, 8)[0][:-1], 9]
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            with listener.accept()[0] as peer:
                while request := peer.recv(12):
                    body = bytes([request[6], 4, 2 * len(words)]) + b"".join(w.to_bytes(2, "big") for w in words)
                    discrete, latch = bytes([request[6], 2, 1, 0]), bytes([request[6], 3, 2, 0, 0])
                    answer = {4: body, 2: discrete, 3: latch}[request[7]]
                    peer.sendall(request[:4] + len(answer).to_bytes(2, "big") + answer)

        thread = threading.Thread(target=serve)
        thread.start()
        with Heard(*listener.getsockname()) as heard:
            assert "sequence 8 at the beginning of the read, 9 at its end" in heard.event()
        thread.join()


def test_a_heartbeat_that_stops_makes_samples_stale(server: CellServer) -> None:
    with Heard("127.0.0.1", server.port) as heard:
        heard.event()
        text = heard.event()
        assert text.startswith("heartbeat stands at 1 for 1.")
        assert "the cell's program has stopped" in text
        assert heard.sample(stale=True).sequence == 1
        server.update(STATE)
        assert heard.event().startswith("heartbeat counts again after ")
        heard.sample(stale=False)
