"""Node guarding and life guarding of a device (CiA 301, 7.2.8.2.1): older than heartbeats, and exclusive of them."""

from collections.abc import Callable

from emulator.store import ObjectStore
from emulator.timers import Timers
from protocols.objects import key

_GUARD_TIME, _FACTOR = key(0x100C), key(0x100D)
_HEARTBEAT = key(0x1017)
_MS = 1_000_000


class NodeGuard:
    """Answers a master that polls with remote frames, and notices when it stops.

    Args:
        answer: Sends the NMT state with this toggle bit.
        lost, found: Called when the master falls silent for 0x100C times 0x100D, and when it asks again.
    """

    def __init__(
        self,
        store: ObjectStore,
        timers: Timers,
        answer: Callable[[int], None],
        lost: Callable[[], None],
        found: Callable[[], None],
    ) -> None:
        self._store = store
        self._timers = timers
        self._answer = answer
        self._lost = lost
        self._found = found
        self._toggle = 0
        self._silent = False
        store.guard(0x100C, consequence=self._configure)
        store.guard(0x100D, consequence=self._configure)

    def reset(self) -> None:
        """As after a reset of communication: the toggle bit begins at 0, the master has not asked yet."""
        self._toggle = 0
        self._silent = False
        self._timers.cancel("guard")

    @property
    def satisfied(self) -> bool:
        """The master asks in time, or never promised to."""
        return not self._silent

    def asked(self) -> None:
        """A remote frame of the master; unanswered where the device sends heartbeats."""
        values = self._store.values
        if values[_HEARTBEAT]:
            return
        self._answer(self._toggle)
        self._toggle ^= 1
        if self._silent:
            self._silent = False
            self._found()
        life_ns = values[_GUARD_TIME] * values[_FACTOR] * _MS
        if life_ns:
            self._timers.schedule("guard", self._timers.now_ns + life_ns, self._expire)

    def _configure(self) -> None:
        if not self._store.values[_GUARD_TIME] * self._store.values[_FACTOR]:
            self._timers.cancel("guard")

    def _expire(self) -> None:
        self._silent = True
        self._lost()
