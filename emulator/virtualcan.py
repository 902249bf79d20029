"""python-can interface `virtualcan`: `can.Bus(interface="virtualcan", channel="127.0.0.1:29536")` joins a hub."""

import select
import socket
import threading
from collections import deque
from collections.abc import Iterable, Sequence
from itertools import repeat

import can
from can.typechecking import CanFilters

from emulator.channel import parse
from protocols.clock import utc_now_ns
from protocols.errors import ConfigError
from protocols.frames import WIRE_BYTES, Frame, decode, encode
from protocols.pythoncan import from_message, to_message

READ_BYTES = 32 * 1024  # below malloc's mmap threshold
CONNECT_S = 2.0
WRITE_S = 2.0  # a hub always reads; one that has not for this long is stopped


class VirtualCanBus(can.BusABC):
    """A client of a CAN hub.

    Besides python-can's one message at a time it moves batches of `Frame`, which is what costs least: `read_frames`
    and `write_frames`. Both ways may be mixed. One thread may read while others write.

    Args:
        channel: `HOST:PORT` or `unix:PATH`.
        can_filters: Applied by python-can to `recv`, not to `read_frames`.

    Raises:
        CanInitializationError: The channel is no address, or no hub answers there.
    """

    def __init__(self, channel: str, can_filters: CanFilters | None = None, **kwargs: object) -> None:
        self.channel = channel
        self.channel_info = f"virtualcan {channel}"
        self._partial = b""
        self._pending: deque[tuple[float, Frame]] = deque()
        self._write_lock = threading.Lock()
        self._socket = _connect(channel)
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def read_frames(self, timeout_s: float | None = None) -> list[Frame]:
        """Everything that has arrived, unfiltered; waits for the first frame.

        Args:
            timeout_s: Longest wait [s]; None waits for ever, 0 not at all.

        Returns:
            Frames in bus order; empty when no whole frame came in time.

        Raises:
            CanOperationError: The hub is gone, or what answers is no hub.
        """
        if self._pending:
            frames = [frame for _, frame in self._pending]
            self._pending.clear()
            return frames
        try:
            data = self._socket.recv(READ_BYTES)
        except BlockingIOError:
            if timeout_s == 0 or not select.select([self._socket], [], [], timeout_s)[0]:
                return []
            return self.read_frames(0)
        except OSError as error:
            raise self._gone(str(error)) from error
        if not data:
            raise self._gone("it closed the connection")
        if self._partial:
            data = self._partial + data
        whole = len(data) - len(data) % WIRE_BYTES
        self._partial = data[whole:]
        try:
            return list(decode(data[:whole]))
        except ValueError as error:
            raise can.CanOperationError(f"what answers at {self.channel} is not a CAN hub: {error}.") from error

    def write_frames(self, frames: Sequence[Frame], stations: Iterable[int] = repeat(0)) -> None:
        """Send a burst with one system call; returns when all of it is under way.

        Args:
            stations: For each frame the controller that sends it, for a client that stands for several.

        Raises:
            CanOperationError: The hub is gone or does not read.
        """
        data = memoryview(encode(frames, stations))
        with self._write_lock:
            while data:
                try:
                    data = data[self._socket.send(data) :]
                except BlockingIOError:
                    if not select.select([], [self._socket], [], WRITE_S)[1]:
                        self._socket.close()  # a record may be half sent: the stream cannot be taken up again
                        raise self._gone(f"it has read nothing for {WRITE_S:.0f} s") from None
                except OSError as error:
                    raise self._gone(str(error)) from error

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one message; `timeout` is python-can's and has no meaning here."""
        self.write_frames([from_message(msg)])

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._pending:
            frames = self.read_frames(timeout)
            arrived_s = utc_now_ns() * 1e-9
            self._pending.extend((arrived_s, frame) for frame in frames)
        if not self._pending:
            return None, False
        arrived_s, frame = self._pending.popleft()
        message = to_message(frame, arrived_s)
        message.channel = self.channel
        return message, False

    def fileno(self) -> int:
        """Descriptor to wait on; frames already taken off it by `recv` do not make it readable."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        super().shutdown()
        self._socket.close()

    def _gone(self, reason: str) -> can.CanOperationError:
        return can.CanOperationError(f"the CAN hub at {self.channel} is gone: {reason}. Start it again and reconnect.")


def _connect(channel: str) -> socket.socket:
    try:
        family, address = parse(channel)
    except ConfigError as error:
        raise can.CanInitializationError(str(error)) from error
    sock = socket.socket(family, socket.SOCK_STREAM)
    sock.settimeout(CONNECT_S)
    try:
        sock.connect(address)
    except OSError as error:
        sock.close()
        raise can.CanInitializationError(
            f"no CAN hub answers at {channel}: {error.strerror or error}. Start the emulator, which serves the hub,"
            " or correct the channel in the rig file."
        ) from error
    sock.setblocking(False)
    if family != socket.AF_UNIX:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return sock
