"""PDO engine of a device (CiA 301, 7.2.2): sends and receives what the dictionary says, and lets it be changed."""

from collections.abc import Callable
from functools import partial

from emulator.emergency import EmergencyProducer
from emulator.store import ObjectStore
from emulator.timers import Timers
from protocols import emcy, nmt
from protocols.dictionary import INVALID, NO_RTR
from protocols.frames import Frame
from protocols.objects import Entry, Value, key
from protocols.pdo import (
    EVENT_TYPES,
    LAST_SYNCHRONOUS,
    MAPPING_OFFSET,
    RECEIVE,
    TRANSMIT,
    Layout,
    compile_mapping,
)
from protocols.sdo import Abort, SdoError

Handler = Callable[[bytes], bool]

_MOST = 512  # PDOs of each direction that a dictionary has room for


class _Receive:
    """One RPDO in use.

    Attributes:
        plain: Its objects need no checks: values are stored as they come.
        pending: Data that waits for the next SYNC.
        short: The last frame had too few bytes.
    """

    __slots__ = ("layout", "number", "pending", "plain", "short", "synchronous")

    def __init__(self, number: int, layout: Layout, *, synchronous: bool, plain: bool) -> None:
        self.number = number
        self.layout = layout
        self.synchronous = synchronous
        self.plain = plain
        self.pending: bytes | None = None
        self.short = False


class _Transmit:
    """One TPDO in use.

    Attributes:
        countdown: SYNCs until it is due.
        last: Data sent last; None before the first.
    """

    __slots__ = ("cob_id", "countdown", "event_ns", "inhibit_ns", "kind", "last", "layout", "not_before_ns", "number")

    def __init__(self, number: int, layout: Layout, cob_id: int, kind: int, inhibit_ns: int, event_ns: int) -> None:
        self.number = number
        self.layout = layout
        self.cob_id = cob_id
        self.kind = kind
        self.inhibit_ns = inhibit_ns
        self.event_ns = event_ns
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
        self._receive: dict[int, _Receive] = {}
        self._transmit: dict[int, _Transmit] = {}
        self._synchronous_receive: list[_Receive] = []
        self._synchronous_transmit: list[_Transmit] = []
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
        self._receive.clear()
        self._transmit.clear()
        self._sort()

    def routes(self) -> dict[int, Handler]:
        """Handlers of the RPDOs in use, by identifier. A handler tells whether anything took effect at once."""
        return {self._cob_id(RECEIVE, n): partial(self._take, pdo) for n, pdo in self._receive.items()}

    # --- frames ---

    def activate(self) -> None:
        """SYNC: the synchronous RPDOs received since the last one take effect."""
        for pdo in self._synchronous_receive:
            if pdo.pending is not None:
                self._apply(pdo, pdo.pending)
                pdo.pending = None

    def transmit(self) -> None:
        """SYNC: send the synchronous TPDOs that are due."""
        values = self._store.values
        for pdo in self._synchronous_transmit:
            if pdo.kind == 1:
                self._send(Frame(pdo.cob_id, pdo.layout.pack(values)))
            elif pdo.kind:
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

    def _take(self, pdo: _Receive, data: bytes) -> bool:
        if len(data) < pdo.layout.size:
            pdo.short = True
            self._emergencies.occur(emcy.Code.PDO_LENGTH, bytes((pdo.number,)))
            return True
        if pdo.short:
            pdo.short = False
            if not any(p.short for p in self._receive.values()):
                self._emergencies.vanish(emcy.Code.PDO_LENGTH)
        if pdo.synchronous:
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
        if base == RECEIVE:
            self._receive.pop(n, None)
        count = values[key(base + MAPPING_OFFSET + n)]
        if self._off(base, n) or count == 0:
            return
        layout, kind = self._layout(base, n, count), values[communication + 2]
        if base == RECEIVE:
            plain = not any(self._store.watched(e) for e in layout.entries)
            self._receive[n] = _Receive(n + 1, layout, synchronous=kind <= LAST_SYNCHRONOUS, plain=plain)
        else:
            inhibit_ns, event_ns = values[communication + 3] * 100_000, values[communication + 5] * 1_000_000
            self._transmit[n] = _Transmit(n + 1, layout, self._cob_id(base, n), kind, inhibit_ns, event_ns)

    def _changed(self, base: int, n: int) -> None:
        if self._running:
            self._build(base, n)
            self._sort()
            self._rerouted()

    def _sort(self) -> None:
        self._synchronous_receive = [p for p in self._receive.values() if p.synchronous]
        self._synchronous_transmit = [p for p in self._transmit.values() if p.kind <= LAST_SYNCHRONOUS]
        self._on_event = [p for p in self._transmit.values() if p.kind in EVENT_TYPES]

    def _cancel(self, pdo: _Transmit) -> None:
        self._timers.cancel(("inhibit", pdo.number))
        self._timers.cancel(("event", pdo.number))

    def _check_communication(self, base: int, n: int, entry: Entry, value: Value) -> None:
        number = int(value)
        if entry.sub == 1:
            self._check_cob_id(base, number, self._store.values[entry.key])
        elif entry.sub == 2 and not (number <= LAST_SYNCHRONOUS or number in EVENT_TYPES):
            raise SdoError(Abort.VALUE)
        elif entry.sub == 3 and not self._off(base, n):  # CiA 301, 7.5.2.37: not while the PDO exists
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
