"""SYNC and TIME of a device (CiA 301, 7.2.5 and 7.2.6): listening, counting, producing."""

import struct
from collections.abc import Callable

from emulator.emergency import EmergencyProducer
from emulator.store import ObjectStore
from emulator.timers import Timers
from protocols import emcy, nmt
from protocols.dictionary import CONSUMES, INVALID, PRODUCES
from protocols.frames import Frame
from protocols.objects import Entry, Value, key
from protocols.sdo import Abort, SdoError

_COB_ID, _PERIOD, _OVERFLOW = key(0x1005), key(0x1006), key(0x1019)
_TIME = key(0x1012)
_MILLISECONDS, _DAYS = key(0x2004, 1), key(0x2004, 2)
_DAY_MS = 86_400_000
_STAMP = struct.Struct("<IH")


class Synchronisation:
    """What a device makes of SYNC, and the SYNC it makes.

    Args:
        send: Takes SYNC frames.
        rerouted: Called when the identifier has moved.
    """

    def __init__(
        self,
        store: ObjectStore,
        timers: Timers,
        emergencies: EmergencyProducer,
        send: Callable[[Frame], None],
        rerouted: Callable[[], None],
    ) -> None:
        self._values = store.values
        self._timers = timers
        self._emergencies = emergencies
        self._send = send
        self._rerouted = rerouted
        self._expected: int | None = None
        self._counter = 0
        self._due_ns = 0
        self.running = False
        store.guard(0x1005, self._check_cob_id, self._move)
        store.guard(0x1006, consequence=self._produce)
        store.guard(0x1019, self._check_overflow, self.forget)

    @property
    def can_id(self) -> int:
        """Where SYNC is."""
        can_id: int = self._values[_COB_ID] & 0x7FF
        return can_id

    def start(self) -> None:
        """The NMT state allows SYNC; after STOPPED the counter begins at 1 (CiA 301, 7.2.5.3.1)."""
        if not self.running:
            self.running = True
            self._counter = 0
            self.forget()
            self._produce()

    def stop(self) -> None:
        self.running = False
        self._timers.cancel("sync producer")

    def forget(self) -> None:
        """Accept any counter next."""
        self._expected = None

    def consume(self, counter: int | None) -> None:
        """Check one SYNC against what was agreed on."""
        overflow = self._values[_OVERFLOW]
        if not overflow:
            self._expected = None
            return
        if counter is None:
            self._emergencies.occur(emcy.Code.SYNC_LENGTH)
            return
        if counter == self._expected:
            self._expected = counter % overflow + 1
            if self._emergencies.any_active:
                self._emergencies.vanish(emcy.Code.SYNC_LENGTH)
                self._emergencies.vanish(emcy.Code.SYNC_JUMP)
            return
        expected, self._expected = self._expected, counter % overflow + 1
        self._emergencies.vanish(emcy.Code.SYNC_LENGTH)
        if expected is not None:
            self._emergencies.occur(emcy.Code.SYNC_JUMP, bytes((expected, counter)))

    # --- producer ---

    def _move(self) -> None:
        self._rerouted()
        self._produce()

    def _produce(self) -> None:
        """Begin, change or end with the present values of 0x1005 and 0x1006."""
        self._timers.cancel("sync producer")
        self._due_ns = self._timers.now_ns
        self._plan()

    def _plan(self) -> None:
        period_ns = self._values[_PERIOD] * 1000
        if self.running and period_ns and self._values[_COB_ID] & PRODUCES:
            self._due_ns = max(self._due_ns + period_ns, self._timers.now_ns + 1)
            self._timers.schedule("sync producer", self._due_ns, self._beat)

    def _beat(self) -> None:
        overflow = self._values[_OVERFLOW]
        data = b""
        if overflow:
            self._counter = nmt.next_counter(self._counter, overflow)
            data = bytes((self._counter,))
        self._send(Frame(self.can_id, data))
        self._plan()

    def _check_cob_id(self, _: Entry, value: Value) -> None:
        new, old = int(value), self._values[_COB_ID]
        if new & ~(INVALID | PRODUCES | 0x7FF) or nmt.is_restricted(new & 0x7FF):
            raise SdoError(Abort.VALUE)
        if old & PRODUCES and (new ^ old) & 0x7FF:  # CiA 301, 7.5.2.5: not while the device produces
            raise SdoError(Abort.STATE)

    def _check_overflow(self, _: Entry, value: Value) -> None:
        if value == 1:  # CiA 301, 7.5.2.22: 0, or 2 to 240
            raise SdoError(Abort.VALUE)
        if self._values[_PERIOD]:
            raise SdoError(Abort.STATE)


class TimeOfDay:
    """TIME consumer: the date that the last message gave, and the time since (0x2004)."""

    def __init__(self, store: ObjectStore, timers: Timers, rerouted: Callable[[], None]) -> None:
        self._values = store.values
        self._timers = timers
        self._heard_ns: int | None = None
        self._heard_ms = 0
        store.guard(0x1012, self._check_cob_id, rerouted)
        store.guard_read(0x2004, self._show)

    @property
    def can_id(self) -> int | None:
        """Where TIME is; None where the device does not listen."""
        word: int = self._values[_TIME]
        return word & 0x7FF if word & CONSUMES else None

    def receive(self, data: bytes) -> None:
        """TIME message: 28 bits of milliseconds after midnight, 16 of days since 1984."""
        if len(data) == _STAMP.size:
            milliseconds, days = _STAMP.unpack(data)
            self._heard_ns = self._timers.now_ns
            self._heard_ms = days * _DAY_MS + (milliseconds & 0x0FFF_FFFF)

    def _show(self, _: Entry) -> None:
        if self._heard_ns is not None:
            now_ms = self._heard_ms + (self._timers.now_ns - self._heard_ns) // 1_000_000
            days, self._values[_MILLISECONDS] = divmod(now_ms, _DAY_MS)
            self._values[_DAYS] = days & 0xFFFF

    def _check_cob_id(self, _: Entry, value: Value) -> None:
        new = int(value)
        if new & ~(CONSUMES | 0x7FF) or nmt.is_restricted(new & 0x7FF):  # no producer
            raise SdoError(Abort.VALUE)
