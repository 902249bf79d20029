"""CAN hub: every client of a bus hears what every other client of that bus says, in one order for all.

For machines without SocketCAN. Left to itself it is an ideal wire: whole virtualcan records (`protocols.frames`) pass
undecoded, what arrives in one read leaves in one write per client. With an `emulator.wire.Wire` in it, a bus has
arbitration, bit timing and errors.
"""

import contextlib
import errno
import logging
import os
import selectors
import signal
import socket
import stat
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import FrameType
from typing import Self

from emulator.channel import Channel, parse
from emulator.disturbance import Disturbance
from emulator.timedbus import Parcel, TimedBus
from emulator.wire import Traffic, Wire
from protocols.clock import RealClock
from protocols.errors import PeerError
from protocols.frames import MAX_DATA, WIRE_BYTES

LOG = logging.getLogger("armrig.hub")

READ_BYTES = 32 * 1024  # below malloc's mmap threshold: a fresh mapping for every read costs more than the read
MAX_QUEUE_BYTES = 8 * 2**20  # half a minute of a full 1 Mbit/s bus; a client further behind has stopped reading
_LENGTH = bytes([WIRE_BYTES - 4])  # the lowest byte of the length field; the other three are 0
_DLC_OFFSET = 9


@dataclass(frozen=True)
class BusCounts:
    """What a bus has carried.

    Attributes:
        frames: Frames received from clients.
        clients: Connected now.
        expelled: Clients disconnected because they fell behind or do not speak virtualcan.
    """

    frames: int
    clients: int
    expelled: int


@dataclass(eq=False)
class _Bus:
    name: str
    listener: socket.socket
    channel: Channel
    timed: TimedBus | None = None
    clients: "dict[_Client, None]" = field(default_factory=dict)  # ordered set
    frames: int = 0
    expelled: int = 0


@dataclass(eq=False)
class _Client:
    bus: _Bus
    sock: socket.socket
    partial: bytes = b""  # received, shorter than a record
    queue: bytearray = field(default_factory=bytearray)  # accepted for this client, not yet sent


def speaks_virtualcan(records: bytes) -> bool:
    """Whether the length and DLC fields of whole records hold what they must; compares columns, decodes nothing."""
    columns = [records[k::WIRE_BYTES] for k in range(4)]
    count = len(columns[0])
    return (
        columns[0] == columns[1] == columns[2] == bytes(count)
        and columns[3] == _LENGTH * count
        and max(records[_DLC_OFFSET::WIRE_BYTES]) <= MAX_DATA
    )


class Hub:
    """Buses served by one process.

    Args:
        buses: Pairs (name, channel); port 0 picks a free one, see `channels`.
        wires: By name, for the buses that are not ideal.

    Raises:
        ConfigError: A channel is no address.
        PeerError: A channel cannot be listened on.
    """

    def __init__(self, buses: Sequence[tuple[str, str]], wires: Mapping[str, Wire] | None = None) -> None:
        # epoll waits in whole milliseconds, select in microseconds; a frame takes a tenth of a millisecond.
        self._selector = selectors.SelectSelector() if wires else selectors.DefaultSelector()
        self._stopping = False
        self._disturbances: deque[Disturbance] = deque()
        self._wake_in, self._wake_out = socket.socketpair()
        self._wake_in.setblocking(False)
        self._selector.register(self._wake_out, selectors.EVENT_READ, None)
        self._buses: list[_Bus] = []
        clock = RealClock()
        try:
            for name, channel in buses:
                listener = _listen(name, parse(channel))
                wire = (wires or {}).get(name)
                bus = _Bus(name, listener, _bound(listener), None if wire is None else TimedBus(wire, clock))
                self._buses.append(bus)
                self._selector.register(listener, selectors.EVENT_READ, bus)
        except BaseException:
            self.close()
            raise

    @property
    def channels(self) -> dict[str, str]:
        """Channel of each bus, with the port that was really bound."""
        return {bus.name: str(bus.channel) for bus in self._buses}

    @property
    def counts(self) -> dict[str, BusCounts]:
        """Traffic of each bus so far."""
        return {bus.name: BusCounts(bus.frames, len(bus.clients), bus.expelled) for bus in self._buses}

    @property
    def traffic(self) -> dict[str, Traffic]:
        """What each bus with a wire has carried."""
        return {bus.name: bus.timed.traffic for bus in self._buses if bus.timed is not None}

    def run(self) -> None:
        """Forward until `stop`."""
        timed = [(bus, bus.timed) for bus in self._buses if bus.timed is not None]
        wait_s = None
        while not self._stopping:
            for key, events in self._selector.select(wait_s):
                if key.data is None:
                    self._obey()
                elif isinstance(key.data, _Bus):
                    self._accept(key.data)
                else:
                    if events & selectors.EVENT_WRITE:
                        self._drain(key.data)
                    if events & selectors.EVENT_READ:
                        self._read(key.data)
            for bus, wire in timed:
                self._deliver(bus, wire.due())
            wait_s = min([wire.wait_s() for _, wire in timed], default=None)

    def stop(self) -> None:
        """End `run`; for signal handlers and other threads."""
        self._stopping = True
        self._wake()

    def disturb(self, disturbance: Disturbance) -> None:
        """From now on this goes wrong, too; for other threads. Nothing happens on an ideal bus."""
        self._disturbances.append(disturbance)
        self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(OSError):  # already stopping, or closed
            self._wake_in.send(b"\0")

    def close(self) -> None:
        """Disconnect everyone."""
        for bus in self._buses:
            for client in bus.clients:
                client.sock.close()
            bus.listener.close()
            if isinstance(bus.channel.address, str):
                with contextlib.suppress(OSError):
                    os.unlink(bus.channel.address)
        self._selector.close()
        self._wake_in.close()
        self._wake_out.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _obey(self) -> None:
        self._wake_out.recv(READ_BYTES)
        while self._disturbances:
            disturbance = self._disturbances.popleft()
            for bus in self._buses:
                if bus.name == disturbance.bus and bus.timed is not None:
                    bus.timed.disturb(disturbance)

    def _deliver(self, bus: _Bus, parcels: Sequence[Parcel]) -> None:
        if not parcels:
            return
        for client in list(bus.clients):
            hears = bus.timed is None or bus.timed.hears(client)
            records = b"".join(
                [r for r, but, to in parcels if to is client or (to is None and hears and client not in but)]
            )
            if records and client in bus.clients:
                self._send(client, records)

    def _accept(self, bus: _Bus) -> None:
        try:
            sock, _ = bus.listener.accept()
        except OSError as error:  # the peer gave up, or this process has no descriptor left
            LOG.warning("%s: a client could not be accepted: %s.", bus.name, error)
            return
        sock.setblocking(False)
        if sock.family != socket.AF_UNIX:
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = _Client(bus, sock)
        bus.clients[client] = None
        if bus.timed is not None:
            bus.timed.join(client)
        self._selector.register(sock, selectors.EVENT_READ, client)

    def _read(self, client: _Client) -> None:
        if client not in client.bus.clients:  # expelled earlier in this round
            return
        try:
            data = client.sock.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:  # reset by the peer: as good as an end of file
            data = b""
        if not data:
            self._forget(client)
            return
        if client.partial:
            data = client.partial + data
        whole = len(data) - len(data) % WIRE_BYTES
        client.partial, records = data[whole:], data[:whole]
        if not records:
            return
        if not speaks_virtualcan(records):
            self._expel(client, "its bytes are not virtualcan records (length 14, DLC at most 8)")
            return
        client.bus.frames += whole // WIRE_BYTES
        if client.bus.timed is not None:
            self._deliver(client.bus, client.bus.timed.offer(client, records))
            return
        for other in [c for c in client.bus.clients if c is not client]:
            self._send(other, records)

    def _send(self, client: _Client, records: bytes) -> None:
        if client.queue:
            client.queue += records
            if len(client.queue) > MAX_QUEUE_BYTES:
                self._expel(client, f"it is {len(client.queue) / 2**20:.0f} MiB behind and does not read")
            return
        try:
            sent = client.sock.send(records)
        except BlockingIOError:
            sent = 0
        except OSError:
            self._forget(client)
            return
        if sent < len(records):
            client.queue += records[sent:]
            self._selector.modify(client.sock, selectors.EVENT_READ | selectors.EVENT_WRITE, client)

    def _drain(self, client: _Client) -> None:
        if client not in client.bus.clients:
            return
        try:
            sent = client.sock.send(memoryview(client.queue)[:READ_BYTES])
        except BlockingIOError:
            return
        except OSError:
            self._forget(client)
            return
        del client.queue[:sent]
        if not client.queue:
            self._selector.modify(client.sock, selectors.EVENT_READ, client)

    def _expel(self, client: _Client, reason: str) -> None:
        client.bus.expelled += 1
        LOG.warning("%s: a client was disconnected because %s.", client.bus.name, reason)
        self._forget(client)

    def _forget(self, client: _Client) -> None:
        del client.bus.clients[client]
        if client.bus.timed is not None:
            client.bus.timed.leave(client)
        self._selector.unregister(client.sock)
        client.sock.close()


def _listen(name: str, channel: Channel) -> socket.socket:
    """Listening socket of a channel; a unix socket that nobody serves any more is replaced."""
    sock = socket.socket(channel.family, socket.SOCK_STREAM)
    try:
        sock.setblocking(False)
        if isinstance(channel.address, str):
            _remove_stale(channel.address)
        else:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(channel.address)
        sock.listen()
    except OSError as error:
        sock.close()
        if error.errno == errno.EADDRINUSE:
            raise PeerError(
                f"bus {name}: {channel} is in use by another process, perhaps another hub."
                " Stop that one, or give the bus another channel in the rig file."
            ) from error
        raise PeerError(f"bus {name}: cannot listen on {channel}: {error.strerror or error}.") from error
    return sock


def _remove_stale(path: str) -> None:
    """Unlink a unix socket left behind by a hub that was killed; one that still answers makes `bind` fail.

    Raises:
        FileExistsError: There is something else of that name.
    """
    if not os.path.lexists(path):
        return
    if not stat.S_ISSOCK(os.lstat(path).st_mode):
        raise FileExistsError(errno.EEXIST, "there is a file of that name that is no socket")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(path)
        except ConnectionRefusedError:
            os.unlink(path)


def _bound(listener: socket.socket) -> Channel:
    address = listener.getsockname()
    return Channel(listener.family, address if isinstance(address, str) else (address[0], address[1]))


def serve(
    buses: Sequence[tuple[str, str]],
    ready: Callable[[dict[str, str]], None] | None = None,
    wires: Mapping[str, Wire] | None = None,
) -> None:
    """Run a hub in the main thread of a process until SIGTERM or SIGINT.

    Args:
        buses, wires: As `Hub`.
        ready: Called with the bound channels once clients can connect.

    Raises:
        ConfigError, PeerError: As `Hub`.
    """
    with Hub(buses, wires) as hub:

        def stop(_signal: int, _frame: FrameType | None) -> None:
            hub.stop()

        before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            if ready:
                ready(hub.channels)
            hub.run()
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
