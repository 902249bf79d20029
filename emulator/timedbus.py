"""A hub's bus with a wire in it: records of clients become frames of stations, what is heard goes back to clients."""

from collections.abc import Hashable, Iterable

from emulator.disturbance import Disturbance
from emulator.wire import Heard, Traffic, Wire
from protocols.clock import Clock
from protocols.frames import decode_numbered, encode

IDLE_S = 1.0
Parcel = tuple[bytes, list[Hashable], Hashable | None]  # record; clients that do not get it; the only one that does


class TimedBus:
    """Stations on a wire for the clients of a hub.

    A client is a station. One that numbers its frames is as many stations as it uses numbers.
    """

    def __init__(self, wire: Wire, clock: Clock) -> None:
        self._wire = wire
        self._clock = clock
        self._numbers: dict[Hashable, set[int]] = {}

    @property
    def traffic(self) -> Traffic:
        return self._wire.traffic

    def join(self, client: Hashable) -> None:
        """A client is there."""
        self._numbers[client] = {0}
        self._wire.join(self._clock.now_ns(), (client, 0))

    def leave(self, client: Hashable) -> None:
        """A client has gone."""
        for number in self._numbers.pop(client):
            self._wire.leave((client, number))

    def disturb(self, disturbance: Disturbance) -> None:
        """From now on this goes wrong, too; its times count from now."""
        disturbance.begin_ns += self._clock.now_ns()
        disturbance.end_ns += self._clock.now_ns()
        self._wire.disturb(disturbance)

    def offer(self, client: Hashable, records: bytes) -> list[Parcel]:
        """Queue whole records of a client.

        Returns:
            What the client is told where its queue is full.
        """
        t_ns = self._clock.now_ns()
        known, refused = self._numbers[client], []
        for number, frame in decode_numbered(records):
            if number not in known:
                self._add(t_ns, client, number)
            answer = self._wire.offer(t_ns, (client, number), frame)
            if answer is not None:
                refused.append(answer)
        return self._parcels(refused)

    def due(self) -> list[Parcel]:
        """What has been on the wire by now."""
        heard = self._wire.advance(self._clock.now_ns())
        return self._parcels(heard) if heard else []

    def wait_s(self) -> float:
        """Until something happens."""
        return min(IDLE_S, max(0.0, (self._wire.next_ns - self._clock.now_ns()) * 1e-9))

    def hears(self, client: Hashable) -> bool:
        """Whether one of a client's stations is on the bus."""
        return any([self._wire.hears((client, number)) for number in self._numbers[client]])

    def _add(self, t_ns: int, client: Hashable, number: int) -> None:
        numbers = self._numbers[client]
        if numbers == {0}:  # a client that stands for several is none itself
            self._wire.leave((client, 0))
            numbers.clear()
        numbers.add(number)
        self._wire.join(t_ns, (client, number), number)

    def _parcels(self, heard: Iterable[Heard]) -> list[Parcel]:
        parcels: list[Parcel] = []
        for h in heard:
            if h.to is None:
                parcels.append((encode([h.frame]), [_client(s) for s in h.senders], None))
            elif _client(h.to) in self._numbers:  # not one that has left meanwhile
                parcels.append((encode([h.frame]), [], _client(h.to)))
        return parcels


def _client(station: Hashable) -> Hashable:
    return station[0] if isinstance(station, tuple) else station
