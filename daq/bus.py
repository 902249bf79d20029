"""Edge: listen to a bus. There is no way to send here: what must not happen is not expressible."""

import select
from collections.abc import Callable, Sequence
from typing import Self

import can

from protocols.clock import Clock
from protocols.errors import PeerError
from protocols.frames import Frame
from protocols.pythoncan import from_message
from protocols.rig import Bus


class Listener:
    """One bus, received in batches with arrival stamps."""

    def __init__(self, name: str, opened: can.BusABC, clock: Clock) -> None:
        self.name = name
        self._bus = opened
        self._clock = clock
        # The hub's interface offers whole batches; every other one gives a message at a time.
        self._batch: Callable[[float], list[Frame]] | None = getattr(opened, "read_frames", None)

    def receive(self) -> list[tuple[int, Frame]]:
        """What has arrived, without waiting: pairs (arrival [ns], frame).

        Raises:
            PeerError: The bus has gone.
        """
        try:
            frames = self._batch(0) if self._batch is not None else self._messages()
        except (can.CanError, OSError) as error:
            raise PeerError(f"bus {self.name}: {error}") from error
        t_ns = self._clock.now_ns()
        return [(t_ns, frame) for frame in frames]

    def _messages(self) -> list[Frame]:
        frames = []
        while (message := self._bus.recv(0)) is not None:
            frames.append(from_message(message))
        return frames

    def fileno(self) -> int:
        """Descriptor to wait on."""
        return self._bus.fileno()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.shutdown()


def open_listener(bus: Bus, clock: Clock) -> Listener:
    """Listen to a bus of a rig.

    Raises:
        PeerError: It does not exist, or python-can has no such interface.
    """
    try:
        if bus.interface == "virtualcan":
            opened = can.Bus(interface="virtualcan", channel=bus.channel)
        else:
            opened = can.Bus(bus.channel, bus.interface, ignore_config=True, bitrate=bus.bitrate)
    except (can.CanError, OSError, ValueError) as error:
        raise PeerError(f"bus {bus.name}: {bus.interface}:{bus.channel} cannot be opened: {error}") from error
    return Listener(bus.name, opened, clock)


def wait_any(listeners: Sequence[Listener], timeout_s: float) -> list[list[tuple[int, Frame]]]:
    """Wait until a bus has frames, then take what all of them have.

    Raises:
        PeerError: A bus has gone.
    """
    ready = select.select(listeners, [], [], timeout_s)[0]
    return [listener.receive() if listener in ready else [] for listener in listeners]
