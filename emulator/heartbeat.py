"""Heartbeats of a device: its own, and those of the nodes it watches (CiA 301, 7.2.8.2.2)."""

from collections.abc import Callable
from functools import partial

from emulator.store import ObjectStore
from emulator.timers import Timers
from protocols import nmt
from protocols.dictionary import CONSUMERS
from protocols.objects import Entry, Value, key
from protocols.sdo import Abort, SdoError

CONSUMED = key(0x1016)
PRODUCED = key(0x1017)
_MS = 1_000_000


class HeartbeatProducer:
    """Sends the NMT state every 0x1017 milliseconds."""

    def __init__(self, store: ObjectStore, timers: Timers, send: Callable[[], None]) -> None:
        self._store = store
        self._timers = timers
        self._send = send
        self._period_ns = 0
        self._due_ns = 0

    def start(self) -> None:
        """Begin, change or end with the present value of 0x1017; the first message comes a period later."""
        self._period_ns = self._store.values[PRODUCED] * _MS
        self._timers.cancel("heartbeat")
        self._due_ns = self._timers.now_ns
        self._plan()

    def _plan(self) -> None:
        if self._period_ns:  # on its grid, but without a burst after a long silence of the clock
            self._due_ns = max(self._due_ns + self._period_ns, self._timers.now_ns + 1)
            self._timers.schedule("heartbeat", self._due_ns, self._beat)

    def _beat(self) -> None:
        self._send()
        self._plan()


class HeartbeatConsumer:
    """Watches nodes; each from its first heartbeat on.

    Args:
        lost: Called with the node that falls silent.
        found: Called when one speaks again.
    """

    def __init__(
        self,
        store: ObjectStore,
        timers: Timers,
        lost: Callable[[int], None],
        found: Callable[[], None],
    ) -> None:
        self._store = store
        self._timers = timers
        self._lost = lost
        self._found = found
        self._silent: set[int] = set()
        self.watched: dict[int, int] = {}
        store.guard(0x1016, self._check)

    def reset(self) -> None:
        self._silent.clear()
        self._cancel()
        self.watched = {}

    def configure(self) -> None:
        """Take over 0x1016."""
        self._cancel()
        words = [self._store.values[CONSUMED + i] for i in range(1, CONSUMERS + 1)]
        self.watched = {w >> 16 & 0x7F: (w & 0xFFFF) * _MS for w in words if w >> 16 & 0x7F and w & 0xFFFF}
        for node in [n for n in self._silent if n not in self.watched]:
            self._recover(node)

    def receive(self, node: int, data: bytes) -> None:
        """Heartbeat of a watched node; anything else under its identifier is ignored."""
        if nmt.decode_heartbeat(data) is None:
            return
        self._recover(node)
        self._timers.schedule(("consumer", node), self._timers.now_ns + self.watched[node], partial(self._expire, node))

    def _recover(self, node: int) -> None:
        if node in self._silent:
            self._silent.discard(node)
            self._found()

    def _expire(self, node: int) -> None:
        self._silent.add(node)
        self._lost(node)

    @property
    def all_found(self) -> bool:
        return not self._silent

    def _cancel(self) -> None:
        for node in self.watched:
            self._timers.cancel(("consumer", node))

    def _check(self, entry: Entry, value: Value) -> None:
        word = int(value)
        node = word >> 16 & 0xFF
        if word >> 24 or node > nmt.MAX_NODE:
            raise SdoError(Abort.VALUE)
        others = [self._store.values[CONSUMED + i] for i in range(1, CONSUMERS + 1) if i != entry.sub]
        if word & 0xFFFF and node and node in {w >> 16 for w in others if w & 0xFFFF}:
            raise SdoError(Abort.INCOMPATIBLE)
