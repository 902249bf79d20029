"""Edge: the buses of a rig as rig and host use them, whatever carries them."""

import errno
import logging
import select
from collections.abc import Collection, Sequence
from typing import Self

import can

from emulator.virtualcan import VirtualCanBus
from protocols.clock import Clock, RealClock
from protocols.errorframes import Class, Status
from protocols.frames import ERROR, Frame
from protocols.pythoncan import cannot_open, from_message, lost, to_message
from protocols.rig import Bus

LOG = logging.getLogger("armrig.bus")

# A full transmit queue (ENOBUFS) is a busy bus for a moment, a bus that acknowledges nothing when it lasts.
RETRY_NS = 1_000_000  # a frame takes 0.1 ms at 1 Mbit/s
DROP_NS = 10_000_000  # a command this late is worth less than the next one
GIVE_UP_NS = 1_000_000_000
MAX_BATCH = 1024  # messages taken at once, so that a flooded bus cannot hold its reader
BLIND_POLL_S = 0.001  # for interfaces without a descriptor to wait on


class FrameBus:
    """One open bus that moves batches of frames.

    Virtualcan goes a batch at a time, every other interface of python-can a message at a time.

    Args:
        nodes: Devices that this process stands for. On a hub with a wire each is a controller of its own, told by the
            identifier's last seven bits (CiA 301, table 39); what goes under none of their identifiers is the first's.

    Attributes:
        dropped: Frames given up because the transmit queue stayed full.
    """

    def __init__(self, bus: Bus, opened: can.BusABC, clock: Clock, nodes: Collection[int] = ()) -> None:
        self.name = bus.name
        self._stations = {n: n if n in nodes else min(nodes) for n in range(128)} if nodes else None
        self.dropped = 0
        self._config = bus
        self._bus = opened
        self._hub = opened if isinstance(opened, VirtualCanBus) else None
        self._clock = clock
        self._full_since_ns: int | None = None

    def send(self, frames: Sequence[Frame]) -> None:
        """Send in order. A frame that finds the transmit queue full for 10 ms is dropped, counted and logged.

        Raises:
            PeerError: The bus has gone, or has acknowledged nothing for a second.
        """
        try:
            if self._hub is not None:
                if self._stations is None:
                    self._hub.write_frames(frames)
                else:
                    self._hub.write_frames(frames, [self._stations[f.can_id & 0x7F] for f in frames])
            else:
                for frame in frames:
                    self._send_one(frame)
        except (can.CanError, OSError) as error:
            raise lost(self._config, error) from error

    def _send_one(self, frame: Frame) -> None:
        begin_ns = self._clock.now_ns()
        while not self._accepted(frame):
            now_ns = self._clock.now_ns()
            if now_ns - begin_ns >= DROP_NS:
                self.dropped += 1
                LOG.warning("bus %s: queue full; frame %X dropped, %d so far", self.name, frame.can_id, self.dropped)
                return
            self._clock.sleep_until(now_ns + RETRY_NS)

    def _accepted(self, frame: Frame) -> bool:
        """Whether the transmit queue took the frame.

        Raises:
            CanOperationError: It has been full for too long, or the bus has gone.
        """
        try:
            self._bus.send(to_message(frame))
        except can.CanOperationError as error:
            now_ns = self._clock.now_ns()
            self._full_since_ns = now_ns if self._full_since_ns is None else self._full_since_ns
            if not _queue_is_full(error) or now_ns - self._full_since_ns > GIVE_UP_NS:
                raise
            return False
        self._full_since_ns = None
        return True

    def receive(self) -> list[Frame]:
        """What has arrived, without waiting.

        Raises:
            PeerError: The bus has gone.
        """
        try:
            if self._hub is not None:
                frames = self._hub.read_frames(0)
            else:
                frames = []
                while len(frames) < MAX_BATCH and (message := self._bus.recv(0)) is not None:
                    frames.append(from_message(message))
        except (can.CanError, OSError) as error:
            raise lost(self._config, error) from error
        self.dropped += sum([_is_overflow(f) for f in frames])
        return frames

    @property
    def blind(self) -> bool:
        """Whether there is no descriptor to wait on: such a bus must be polled."""
        try:
            self._bus.fileno()
        except NotImplementedError:
            return True
        return False

    def fileno(self) -> int:
        """Descriptor to wait on."""
        return self._bus.fileno()

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _is_overflow(frame: Frame) -> bool:
    """Whether a controller reports that its transmit queue was full."""
    report = ERROR | Class.CONTROLLER
    return frame.can_id & report == report and bool(frame.data[1:2]) and bool(frame.data[1] & Status.TX_OVERFLOW)


def _queue_is_full(error: can.CanOperationError) -> bool:
    # python-can says it in words when select() finds the socket not writable.
    return error.error_code == errno.ENOBUFS or "Transmit buffer full" in str(error)


def open_bus(bus: Bus, nodes: Collection[int] = ()) -> FrameBus:
    """Join a bus of a rig.

    Args:
        nodes: As `FrameBus`.

    Raises:
        PeerError: It does not exist, nobody serves it, or python-can has no such interface; says what to do.
    """
    try:
        if bus.interface == "virtualcan":
            return FrameBus(bus, VirtualCanBus(bus.channel), RealClock(), nodes)
        opened = can.Bus(bus.channel, bus.interface, ignore_config=True, bitrate=bus.bitrate)
    except (can.CanError, NotImplementedError, OSError, ValueError) as error:
        raise cannot_open(bus, error) from error
    return FrameBus(bus, opened, RealClock())


def receive_any(buses: Sequence[FrameBus], timeout_s: float) -> list[list[Frame]]:
    """Wait until a bus has frames, then take what all of them have. Blind buses are looked at every millisecond.

    Raises:
        PeerError: A bus has gone.
    """
    waited_for = [bus for bus in buses if not bus.blind]
    if len(waited_for) < len(buses):
        timeout_s = min(timeout_s, BLIND_POLL_S)
    ready = select.select(waited_for, [], [], timeout_s)[0]
    return [bus.receive() if bus in ready or bus not in waited_for else [] for bus in buses]
