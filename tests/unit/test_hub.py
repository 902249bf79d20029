"""The hub against raw sockets: bad addresses, bad speakers, slow readers, torn records."""

import contextlib
import logging
import os
import signal
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.channel import Channel, parse
from emulator.hub import MAX_QUEUE_BYTES, Hub, serve, speaks_virtualcan
from protocols.errors import ConfigError, PeerError
from protocols.frames import WIRE_BYTES, Frame, encode

DEADLINE_S = 5.0
RECORD = encode([Frame(0x181, b"\x01\x02")])


class Running:
    """A hub in a thread, and raw sockets on it."""

    def __init__(self, hub: Hub) -> None:
        self.hub = hub
        self._thread = threading.Thread(target=hub.run)
        self._thread.start()
        self._joined: list[socket.socket] = []

    def join(self, bus: str = "can0") -> socket.socket:
        """A client that the hub knows: it has heard the others, or is alone."""
        family, address = parse(self.hub.channels[bus])
        sock = socket.socket(family)
        sock.settimeout(DEADLINE_S)
        known = self.hub.counts[bus].clients
        sock.connect(address)
        while self.hub.counts[bus].clients == known:
            pass
        self._joined.append(sock)
        return sock

    def end(self) -> None:
        self.hub.stop()
        self._thread.join()
        for sock in self._joined:
            sock.close()


@pytest.fixture
def running() -> Iterator[Running]:
    with Hub([("can0", "127.0.0.1:0"), ("can1", "127.0.0.1:0")]) as hub:
        running = Running(hub)
        yield running
        running.end()


def receive(sock: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size and (more := sock.recv(size - len(data))):
        data += more
    return data


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("127.0.0.1:29536", Channel(socket.AF_INET, ("127.0.0.1", 29536))),
        ("[::1]:0", Channel(socket.AF_INET6, ("::1", 0))),
        ("unix:/tmp/can0", Channel(socket.AF_UNIX, "/tmp/can0")),
    ],
)
def test_addresses(text: str, expected: Channel) -> None:
    assert parse(text) == expected
    assert str(parse(text)) == text


@pytest.mark.parametrize("text", ["vcan0", "127.0.0.1", "127.0.0.1:port", "127.0.0.1:65536", ":29536", "unix:", "h:²"])
def test_what_is_no_address_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ConfigError, match="is no address of a CAN hub: write HOST:PORT .* or unix:PATH"):
        parse(text)


@given(st.lists(st.builds(Frame, st.integers(0, 0x7FF), st.binary(max_size=8)), min_size=1, max_size=20))
def test_every_frame_is_recognised_and_every_shift_of_it_is_not(frames: list[Frame]) -> None:
    records = encode(frames)
    assert speaks_virtualcan(records)
    assert not speaks_virtualcan(records[1:] + records[:1])


def test_too_long_a_frame_is_not_virtualcan() -> None:
    record = bytearray(RECORD)
    record[9] = 9
    assert not speaks_virtualcan(bytes(record))


def test_buses_are_apart(running: Running) -> None:
    speaker, listener, elsewhere = running.join(), running.join(), running.join("can1")
    speaker.sendall(RECORD * 3)
    assert receive(listener, 3 * WIRE_BYTES) == RECORD * 3
    elsewhere.setblocking(False)
    with pytest.raises(BlockingIOError):
        elsewhere.recv(1)
    assert running.hub.counts["can0"].frames == 3
    assert running.hub.counts["can1"].frames == 0


def test_records_cut_anywhere_arrive_whole(running: Running) -> None:
    speaker, listener = running.join(), running.join()
    stream = encode([Frame(0x100 + n, bytes([n])) for n in range(50)])
    for begin in range(0, len(stream), 7):
        speaker.sendall(stream[begin : begin + 7])
    assert receive(listener, len(stream)) == stream


def test_who_does_not_speak_virtualcan_is_shown_out(running: Running, caplog: pytest.LogCaptureFixture) -> None:
    speaker, listener, browser = running.join(), running.join(), running.join()
    with caplog.at_level(logging.WARNING, "armrig.hub"):
        browser.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert browser.recv(1) == b""
    assert "can0: a client was disconnected because its bytes are not virtualcan records" in caplog.text
    speaker.sendall(RECORD)
    assert receive(listener, WIRE_BYTES) == RECORD
    assert running.hub.counts["can0"].expelled == 1
    assert running.hub.counts["can0"].clients == 2


def test_who_stops_reading_is_dropped_and_delays_nobody(running: Running, caplog: pytest.LogCaptureFixture) -> None:
    speaker, listener, sleeper = running.join(), running.join(), running.join()
    batch = RECORD * 1800
    with caplog.at_level(logging.WARNING, "armrig.hub"):
        sent = 0
        while running.hub.counts["can0"].expelled == 0:
            speaker.sendall(batch)
            assert receive(listener, len(batch)) == batch
            sent += len(batch)
    assert sent > MAX_QUEUE_BYTES
    assert "MiB behind and does not read" in caplog.text
    received = 0
    with contextlib.suppress(ConnectionResetError):
        while more := sleeper.recv(2**20):
            received += len(more)
    assert received < sent


def test_a_reader_that_pauses_loses_nothing(running: Running) -> None:
    speaker, pausing = running.join(), running.join()
    stream = b"".join(encode([Frame(n % 0x700, n.to_bytes(4, "big"))]) for n in range(300_000))
    speaker.sendall(stream)
    assert receive(pausing, len(stream)) == stream


def test_a_port_in_use_is_refused_with_both_names(running: Running) -> None:
    channel = running.hub.channels["can0"]
    with pytest.raises(PeerError, match=f"bus can9: {channel} is in use by another process.*another channel"):
        Hub([("can8", "127.0.0.1:0"), ("can9", channel)])


def test_an_address_that_is_not_ours_is_refused() -> None:
    with pytest.raises(PeerError, match=r"bus can0: cannot listen on 192.0.2.1:0: Cannot assign requested address\."):
        Hub([("can0", "192.0.2.1:0")])


def test_a_unix_socket_in_use_is_refused_and_a_stale_one_replaced(tmp_path: Path) -> None:
    path = tmp_path / "can0"
    with Hub([("can0", f"unix:{path}")]), pytest.raises(PeerError, match="is in use by another process"):
        Hub([("can0", f"unix:{path}")])
    assert not path.exists()
    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(str(path))
    assert path.exists()
    with Hub([("can0", f"unix:{path}")]) as hub:
        assert hub.channels == {"can0": f"unix:{path}"}


def test_a_file_in_the_way_is_not_deleted(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("precious")
    with pytest.raises(PeerError, match="cannot listen on unix:.*there is a file of that name that is no socket"):
        Hub([("can0", f"unix:{path}")])
    assert path.read_text() == "precious"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_serve_ends_on_a_signal_and_restores_the_handlers(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    heard: list[dict[str, str]] = []

    def ready(channels: dict[str, str]) -> None:
        heard.append(channels)
        os.kill(os.getpid(), number)

    serve([("can0", "127.0.0.1:0")], ready)
    assert heard[0]["can0"].startswith("127.0.0.1:")
    assert signal.getsignal(number) is before
