"""Edge: the buses of a rig as rig and host use them, whatever carries them."""

import errno
import select
from collections.abc import Sequence
from typing import Self

import can

from emulator.virtualcan import VirtualCanBus
from protocols.clock import Clock, RealClock
from protocols.errors import PeerError
from protocols.frames import Frame
from protocols.pythoncan import from_message, to_message
from protocols.rig import Bus

RETRY_NS = 1_000_000  # a full transmit queue (ENOBUFS) empties by itself: a frame takes 0.1 ms at 1 Mbit/s
GIVE_UP_NS = 1_000_000_000  # a queue that stays full for so long means a bus that acknowledges nothing


class FrameBus:
    """One open bus that moves batches of frames.

    Virtualcan goes a batch at a time, every other interface of python-can a message at a time.
    """

    def __init__(self, name: str, opened: can.BusABC, clock: Clock) -> None:
        self.name = name
        self._bus = opened
        self._hub = opened if isinstance(opened, VirtualCanBus) else None
        self._clock = clock

    def send(self, frames: Sequence[Frame]) -> None:
        """Send in order.

        Raises:
            PeerError: The bus has gone, or acknowledges nothing.
        """
        try:
            if self._hub is not None:
                self._hub.write_frames(frames)
            else:
                for frame in frames:
                    self._send_one(frame)
        except (can.CanError, OSError) as error:
            raise PeerError(f"bus {self.name}: {error}") from error

    def _send_one(self, frame: Frame) -> None:
        end_ns = self._clock.now_ns() + GIVE_UP_NS
        while True:
            try:
                self._bus.send(to_message(frame))
                return
            except can.CanOperationError as error:
                if error.error_code != errno.ENOBUFS or self._clock.now_ns() > end_ns:
                    raise
            self._clock.sleep_until(self._clock.now_ns() + RETRY_NS)

    def receive(self) -> list[Frame]:
        """What has arrived, without waiting.

        Raises:
            PeerError: The bus has gone.
        """
        try:
            if self._hub is not None:
                return self._hub.read_frames(0)
            frames = []
            while (message := self._bus.recv(0)) is not None:
                frames.append(from_message(message))
            return frames
        except (can.CanError, OSError) as error:
            raise PeerError(f"bus {self.name}: {error}") from error

    def fileno(self) -> int:
        """Descriptor to wait on."""
        return self._bus.fileno()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.shutdown()


def open_bus(bus: Bus) -> FrameBus:
    """Join a bus of a rig.

    Raises:
        PeerError: It does not exist, or python-can has no such interface.
    """
    try:
        if bus.interface == "virtualcan":
            return FrameBus(bus.name, VirtualCanBus(bus.channel), RealClock())
        opened = can.Bus(bus.channel, bus.interface, ignore_config=True, bitrate=bus.bitrate)
    except (can.CanError, OSError, ValueError) as error:
        advice = ""
        if bus.interface == "socketcan":
            advice = f" Create it with: ip link add {bus.channel} type vcan && ip link set {bus.channel} up."
        raise PeerError(f"bus {bus.name}: {bus.interface}:{bus.channel} cannot be opened: {error}.{advice}") from error
    return FrameBus(bus.name, opened, RealClock())


def receive_any(buses: Sequence[FrameBus], timeout_s: float) -> list[list[Frame]]:
    """Wait until a bus has frames, then take what all of them have.

    Raises:
        PeerError: A bus has gone.
    """
    ready = select.select(buses, [], [], timeout_s)[0]
    return [bus.receive() if bus in ready else [] for bus in buses]
