"""PDO engine of a device (CiA 301, 7.2.2): sends and receives what the dictionary says, and lets it be changed."""

from collections.abc import Callable
from functools import partial

from emulator.emergency import EmergencyProducer
from emulator.store import ObjectStore
from emulator.timers import Timers
from protocols import emcy, nmt
from protocols.dictionary import INVALID, NO_RTR
from protocols.frames import REMOTE, Frame
from protocols.objects import Entry, Value, key
from protocols.pdo import (
    EVENT_TYPES,
    LAST_SYNCHRONOUS,
    MAPPING_OFFSET,
    ON_REQUEST,
    RECEIVE,
    SAMPLED_ON_SYNC,
    TRANSMIT,
    Layout,
    compile_mapping,
)
from protocols.sdo import Abort, SdoError

Handler = Callable[[bytes], bool]

_WINDOW = key(0x1007)
_MOST = 512  # PDOs of each direction that a dictionary has room for


class _Receive:
    """One RPDO in use.

    Attributes:
        plain: Its objects need no checks: values are stored as they come.
        deadline_ns: A frame is due so long after the one before; 0: whenever it likes.
        pending: Data that waits for the next SYNC.
        short: The last frame had too few bytes.
        late: The deadline has passed.
    """

    __slots__ = ("deadline_ns", "late", "layout", "number", "pending", "plain", "short", "synchronous")

    def __init__(self, number: int, layout: Layout, deadline_ns: int, *, synchronous: bool, plain: bool) -> None:
        self.number = number
        self.layout = layout
        self.deadline_ns = deadline_ns
        self.late = False
        self.synchronous = synchronous
        self.plain = plain
        self.pending: bytes | None = None
        self.short = False


class _Transmit:
    """One TPDO in use.

    Attributes:
        start: SYNC counter that it waits for, once (0x1800:6); 0: any.
        countdown: SYNCs until it is due.
        last: Data sent or sampled last; None before the first.
    """

    __slots__ = (
        "cob_id",
        "countdown",
        "event_ns",
        "inhibit_ns",
        "kind",
        "last",
        "layout",
        "not_before_ns",
        "number",
        "start",
    )

    def __init__(
        self, number: int, layout: Layout, cob_id: int, kind: int, inhibit_ns: int, event_ns: int, start: int
    ) -> None:
        self.number = number
        self.layout = layout
        self.cob_id = cob_id
        self.kind = kind
        self.inhibit_ns = inhibit_ns
        self.event_ns = event_ns
        self.start = start
        self.countdown = kind
        self.last: bytes | None = None
        self.not_before_ns = 0


class PdoEngine:
    """All PDOs of one device. Idle unless `start`ed, which is what the NMT state OPERATIONAL means for them.

    Args:
        rerouted: Called when the identifiers it listens to may have changed.
        emergencies: Told of frames that are too short.
        send: Takes TPDOs.
    """

    def __init__(
        self,
        store: ObjectStore,
        timers: Timers,
        emergencies: EmergencyProducer,
        send: Callable[[Frame], None],
        rerouted: Callable[[], None],
    ) -> None:
        self._store = store
        self._timers = timers
        self._emergencies = emergencies
        self._send = send
        self._rerouted = rerouted
        self._running = False
        self._sync_ns = 0
        self._receive: dict[int, _Receive] = {}
        self._transmit: dict[int, _Transmit] = {}
        self._synchronous_receive: list[_Receive] = []
        self._every_sync: list[_Transmit] = []
        self._some_syncs: list[_Transmit] = []
        self._on_event: list[_Transmit] = []
        objects = store.dictionary.objects
        self._present = [(base, n) for base in (RECEIVE, TRANSMIT) for n in range(_MOST) if base + n in objects]
        for base, n in self._present:
            consequence = partial(self._changed, base, n)
            store.guard(base + n, partial(self._check_communication, base, n), consequence)
            store.guard(base + MAPPING_OFFSET + n, partial(self._check_mapping, base, n), consequence)

    # --- life ---

    def start(self) -> None:
        """Take all PDOs into use; event-driven ones are sent with the next `check_events`."""
        self._running = True
        for base, n in self._present:
            self._build(base, n)
        self._sort()

    def stop(self) -> None:
        """Take all PDOs out of use."""
        self._running = False
        for pdo in self._transmit.values():
            self._cancel(pdo)
        for waiting in self._receive.values():
            self._timers.cancel(("deadline", waiting.number))
        self._receive.clear()
        self._transmit.clear()
        self._sort()

    def routes(self) -> dict[int, Handler]:
        """Handlers of the RPDOs in use and of remote frames for TPDOs, by identifier. A handler tells whether anything
        took effect at once."""
        handlers: dict[int, Handler] = {}
        for n, pdo in self._transmit.items():
            if not self._store.values[key(TRANSMIT + n, 1)] & NO_RTR:
                handlers[pdo.cob_id | REMOTE] = partial(self._requested, pdo)
        for n, expected in self._receive.items():
            handlers[self._cob_id(RECEIVE, n)] = partial(self._take, expected)
        return handlers

    # --- frames ---

    def activate(self, t_ns: int) -> None:
        """SYNC: the synchronous RPDOs received since the last one take effect."""
        self._sync_ns = t_ns
        for pdo in self._synchronous_receive:
            if pdo.pending is not None:
                self._apply(pdo, pdo.pending)
                pdo.pending = None

    def transmit(self, counter: int | None) -> None:
        """SYNC: send the synchronous TPDOs that are due."""
        values = self._store.values
        for pdo in self._every_sync:
            self._send(Frame(pdo.cob_id, pdo.layout.pack(values)))
        for pdo in self._some_syncs:
            if pdo.kind == SAMPLED_ON_SYNC:
                pdo.last = pdo.layout.pack(values)
                continue
            if pdo.start:
                if counter is not None and counter != pdo.start:
                    continue
                pdo.start = 0
            if pdo.kind:
                pdo.countdown -= 1
                if pdo.countdown == 0:
                    pdo.countdown = pdo.kind
                    self._send(Frame(pdo.cob_id, pdo.layout.pack(values)))
            else:  # type 0: on a SYNC, but only after a change
                data = pdo.layout.pack(values)
                if data != pdo.last:
                    pdo.last = data
                    self._send(Frame(pdo.cob_id, data))

    def check_events(self) -> None:
        """Send the event-driven TPDOs whose data have changed, now or when their inhibit time is over."""
        for pdo in self._on_event:
            if pdo.layout.pack(self._store.values) != pdo.last:
                self._send_event(pdo)

    def _send_event(self, pdo: _Transmit) -> None:
        now_ns = self._timers.now_ns
        if now_ns < pdo.not_before_ns:
            self._timers.schedule(("inhibit", pdo.number), pdo.not_before_ns, partial(self._send_event, pdo))
            return
        pdo.last = pdo.layout.pack(self._store.values)
        self._send(Frame(pdo.cob_id, pdo.last))
        pdo.not_before_ns = now_ns + pdo.inhibit_ns
        self._timers.cancel(("inhibit", pdo.number))
        if pdo.event_ns:
            self._timers.schedule(("event", pdo.number), now_ns + pdo.event_ns, partial(self._send_event, pdo))

    def _requested(self, pdo: _Transmit, _: bytes) -> bool:
        """A remote frame asks for a TPDO."""
        if pdo.kind != SAMPLED_ON_SYNC:
            self._send(Frame(pdo.cob_id, pdo.layout.pack(self._store.values)))
        elif pdo.last is not None:
            self._send(Frame(pdo.cob_id, pdo.last))
        return False

    def _miss(self, pdo: _Receive) -> None:
        pdo.late = True
        self._emergencies.occur(emcy.Code.RPDO_TIMEOUT, bytes((pdo.number,)))

    def _expect(self, pdo: _Receive) -> None:
        """The next frame of an RPDO with a deadline."""
        self._timers.schedule(("deadline", pdo.number), self._timers.now_ns + pdo.deadline_ns, partial(self._miss, pdo))
        if pdo.late:
            pdo.late = False
            if not any(p.late for p in self._receive.values()):
                self._emergencies.vanish(emcy.Code.RPDO_TIMEOUT)

    def _take(self, pdo: _Receive, data: bytes) -> bool:
        if len(data) < pdo.layout.size:
            pdo.short = True
            self._emergencies.occur(emcy.Code.PDO_LENGTH, bytes((pdo.number,)))
            return True
        if pdo.short:
            pdo.short = False
            if not any(p.short for p in self._receive.values()):
                self._emergencies.vanish(emcy.Code.PDO_LENGTH)
        if pdo.deadline_ns:
            self._expect(pdo)
        if pdo.synchronous:
            window_us = self._store.values.get(_WINDOW)
            if not window_us or self._timers.now_ns - self._sync_ns <= 1000 * window_us:
                pdo.pending = data
            return False
        self._apply(pdo, data)
        return True

    def _apply(self, pdo: _Receive, data: bytes) -> None:
        values = pdo.layout.unpack(data)
        if pdo.plain:
            self._store.values.update(zip(pdo.layout.keys, values, strict=True))
            return
        for entry, value in zip(pdo.layout.entries, values, strict=True):
            try:
                self._store.put(entry, value)
            except SdoError:
                continue  # a PDO is not answered: what an SDO would refuse is left as it was

    # --- configuration ---

    def _cob_id(self, base: int, n: int) -> int:
        cob_id: int = self._store.values[key(base + n, 1)]
        return cob_id & 0x7FF

    def _layout(self, base: int, n: int, count: int) -> Layout:
        mapping = key(base + MAPPING_OFFSET + n)
        words = [self._store.values[mapping + i] for i in range(1, count + 1)]
        return compile_mapping(words, self._store.dictionary, transmit=base == TRANSMIT)

    def _off(self, base: int, n: int) -> bool:
        return bool(self._store.values[key(base + n, 1)] & INVALID)

    def _build(self, base: int, n: int) -> None:
        values, communication = self._store.values, key(base + n)
        if base == TRANSMIT and n in self._transmit:
            self._cancel(self._transmit.pop(n))
        if base == RECEIVE and n in self._receive:
            self._timers.cancel(("deadline", self._receive.pop(n).number))
        count = values[key(base + MAPPING_OFFSET + n)]
        if self._off(base, n) or count == 0:
            return
        layout, kind = self._layout(base, n, count), values[communication + 2]
        if base == RECEIVE:
            plain = not any(self._store.watched(e) for e in layout.entries)
            deadline_ns = values[communication + 5] * 1_000_000
            self._receive[n] = _Receive(n + 1, layout, deadline_ns, synchronous=kind <= LAST_SYNCHRONOUS, plain=plain)
        else:
            inhibit_ns, event_ns = values[communication + 3] * 100_000, values[communication + 5] * 1_000_000
            start = values[communication + 6]
            self._transmit[n] = _Transmit(n + 1, layout, self._cob_id(base, n), kind, inhibit_ns, event_ns, start)

    def _changed(self, base: int, n: int) -> None:
        if self._running:
            self._build(base, n)
            self._sort()
            self._rerouted()

    def _sort(self) -> None:
        self._synchronous_receive = [p for p in self._receive.values() if p.synchronous]
        on_sync = [p for p in self._transmit.values() if p.kind <= LAST_SYNCHRONOUS or p.kind == SAMPLED_ON_SYNC]
        self._every_sync = [p for p in on_sync if p.kind == 1 and not p.start]
        self._some_syncs = [p for p in on_sync if p.kind != 1 or p.start]
        self._on_event = [p for p in self._transmit.values() if p.kind in EVENT_TYPES]

    def _cancel(self, pdo: _Transmit) -> None:
        self._timers.cancel(("inhibit", pdo.number))
        self._timers.cancel(("event", pdo.number))

    def _check_communication(self, base: int, n: int, entry: Entry, value: Value) -> None:
        number = int(value)
        if entry.sub == 1:
            self._check_cob_id(base, number, self._store.values[entry.key])
        elif entry.sub == 2:
            on_request = base == TRANSMIT and number in {SAMPLED_ON_SYNC, ON_REQUEST}
            if not (number <= LAST_SYNCHRONOUS or number in EVENT_TYPES or on_request):
                raise SdoError(Abort.VALUE)
        elif entry.sub in {3, 6} and not self._off(base, n):  # CiA 301, 7.5.2.37: not while the PDO exists
            raise SdoError(Abort.STATE)

    @staticmethod
    def _check_cob_id(base: int, new: int, old: int) -> None:
        ignored = INVALID | (NO_RTR if base == TRANSMIT else 0)
        if new & ~(ignored | 0x7FF):  # 29-bit identifiers are not supported
            raise SdoError(Abort.VALUE)
        if not new & INVALID and nmt.is_restricted(new & 0x7FF):
            raise SdoError(Abort.VALUE)
        if (new ^ old) & 0x7FF and not (new | old) & INVALID:  # the identifier moves only while the PDO is off
            raise SdoError(Abort.STATE)

    def _check_mapping(self, base: int, n: int, entry: Entry, value: Value) -> None:
        number = int(value)
        mapping = key(base + MAPPING_OFFSET + n)
        if not self._off(base, n):
            raise SdoError(Abort.STATE)
        if entry.sub == 0:
            if mapping + number not in self._store.values:
                raise SdoError(Abort.PDO_LENGTH)
            self._layout(base, n, number)
        elif self._store.values[mapping]:  # entries change only while their number is 0
            raise SdoError(Abort.STATE)
        elif number:
            compile_mapping([number], self._store.dictionary, transmit=base == TRANSMIT)
