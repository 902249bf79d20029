"""Edge: listen to a bus. There is no way to send here: what must not happen is not expressible.

SocketCAN is read by `daq.rawcan`, everything else through python-can.
"""

import select
from collections.abc import Callable, Sequence
from typing import Protocol, Self

import can

from daq.rawcan import RawSocket
from protocols.clock import Clock
from protocols.frames import Frame
from protocols.pythoncan import cannot_open, from_message, lost
from protocols.rig import Bus

MAX_BATCH = 4096  # messages taken at once, so that a flooded bus cannot starve the others
BLIND_POLL_S = 0.001  # for interfaces without a descriptor to wait on


class Listener(Protocol):
    """One bus, received in batches with arrival stamps.

    Attributes:
        name: The rig's.
        stamps: Where the arrival stamps come from, in words.
        blind: Whether there is no descriptor to wait on: such a bus must be polled.
    """

    name: str
    stamps: str

    @property
    def blind(self) -> bool: ...

    def receive(self) -> list[tuple[int, Frame]]:
        """What has arrived, without waiting: pairs (arrival [ns], frame).

        Raises:
            PeerError: The bus has gone.
        """

    def count_drops(self) -> int:
        """Frames known to be lost on the way to us so far."""

    def take_remarks(self) -> list[str]:
        """What has happened to the interface since the last call, in words."""

    def fileno(self) -> int:
        """Descriptor to wait on."""

    def close(self) -> None:
        """Leave the bus."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


class PythonCanListener:
    """Any interface of python-can. Frames of one read share a stamp."""

    stamps = "arrival stamps are this process's"

    def __init__(self, bus: Bus, opened: can.BusABC, clock: Clock) -> None:
        self.name = bus.name
        self._config = bus
        self._bus = opened
        self._clock = clock
        # The hub's interface offers whole batches; every other one gives a message at a time.
        self._batch: Callable[[float], list[Frame]] | None = getattr(opened, "read_frames", None)

    def receive(self) -> list[tuple[int, Frame]]:
        """As `Listener`."""
        try:
            frames = self._batch(0) if self._batch is not None else self._messages()
        except (can.CanError, OSError) as error:
            raise lost(self._config, error) from error
        t_ns = self._clock.now_ns()
        return [(t_ns, frame) for frame in frames]

    def _messages(self) -> list[Frame]:
        frames: list[Frame] = []
        while len(frames) < MAX_BATCH and (message := self._bus.recv(0)) is not None:
            frames.append(from_message(message))
        return frames

    def count_drops(self) -> int:
        """None that python-can would tell."""
        return 0

    def take_remarks(self) -> list[str]:
        """None that python-can would tell."""
        return []

    @property
    def blind(self) -> bool:
        """As `Listener`."""
        try:
            self._bus.fileno()
        except NotImplementedError:
            return True
        return False

    def fileno(self) -> int:
        """As `Listener`."""
        return self._bus.fileno()

    def close(self) -> None:
        """As `Listener`."""
        self._bus.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_listener(bus: Bus, clock: Clock) -> Listener:
    """Listen to a bus of a rig.

    Raises:
        PeerError: It does not exist, nobody serves it, or python-can has no such interface; says what to do.
    """
    if bus.interface == "socketcan":
        return RawSocket(bus, clock)
    try:
        # python-can finds `virtualcan` by its entry point; the module is the emulator's and is not imported here.
        opened = can.Bus(bus.channel, bus.interface, ignore_config=True, bitrate=bus.bitrate)
    except (can.CanError, NotImplementedError, OSError, ValueError) as error:
        raise cannot_open(bus, error) from error
    return PythonCanListener(bus, opened, clock)


def wait_any(listeners: Sequence[Listener], timeout_s: float) -> list[list[tuple[int, Frame]]]:
    """Wait until a bus has frames, then take what all of them have. Blind buses are looked at every millisecond.

    Raises:
        PeerError: A bus has gone.
    """
    waited_for = [listener for listener in listeners if not listener.blind]
    if len(waited_for) < len(listeners):
        timeout_s = min(timeout_s, BLIND_POLL_S)
    ready = select.select(waited_for, [], [], timeout_s)[0]
    return [one.receive() if one in ready or one not in waited_for else [] for one in listeners]
