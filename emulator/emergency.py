"""Emergency producer of a device (CiA 301, 7.2.7): error register, history, inhibit time, one message per change."""

from collections import deque
from collections.abc import Callable

from emulator.store import ObjectStore
from emulator.timers import Timers
from protocols import emcy, nmt
from protocols.dictionary import ERRORS, INVALID
from protocols.frames import Frame
from protocols.objects import Entry, Value, key
from protocols.sdo import Abort, SdoError

REGISTER = key(0x1001)
HISTORY = key(0x1003)
COB_ID = key(0x1014)
INHIBIT = key(0x1015)
_WAITING = 16  # messages kept back by the inhibit time; the oldest go first when more come


class EmergencyProducer:
    """Errors of one device.

    Args:
        send: Takes the messages.

    Attributes:
        enabled: Whether the NMT state allows messages; without, errors are only remembered.
    """

    def __init__(self, store: ObjectStore, timers: Timers, send: Callable[[Frame], None]) -> None:
        self._store = store
        self._timers = timers
        self._send = send
        self._active: dict[int, emcy.Register] = {}
        self._waiting: deque[emcy.Emergency] = deque(maxlen=_WAITING)
        self._not_before_ns = 0
        self.enabled = False
        store.guard(0x1003, self._check_history, self._clear_history)
        store.guard_read(0x1003, self._check_history_read)
        store.guard(0x1014, self._check_cob_id)

    def reset(self, *, communication_only: bool) -> None:
        """Forget errors without a message: those of communication, or all."""
        kept = {c: r for c, r in self._active.items() if communication_only and not r & emcy.Register.COMMUNICATION}
        self._active = kept
        self._waiting.clear()
        self._not_before_ns = 0
        self._update_register()

    def is_active(self, code: int) -> bool:
        return code in self._active

    @property
    def any_active(self) -> bool:
        return bool(self._active)

    def occur(self, code: int, detail: bytes = b"") -> None:
        """An error is there. Repeating it while it lasts says nothing new.

        Args:
            detail: Up to five bytes of ours.
        """
        if code in self._active:
            return
        self._active[code] = emcy.register_of(code)
        register = self._update_register()
        self._remember(code)
        self._post(emcy.Emergency(code, register, detail[:5].ljust(5, b"\0")))

    def vanish(self, code: int) -> None:
        """An error has gone: code 0 with what is left in the register."""
        if self._active.pop(code, None) is not None:
            self._post(emcy.Emergency(emcy.Code.NONE, self._update_register()))

    def _update_register(self) -> int:
        register = emcy.Register(0)
        for bits in self._active.values():
            register |= bits
        self._store.values[REGISTER] = int(register)
        return int(register)

    def _remember(self, code: int) -> None:
        values = self._store.values
        count = min(ERRORS, values[HISTORY] + 1)
        for i in range(count, 1, -1):
            values[HISTORY + i] = values[HISTORY + i - 1]
        values[HISTORY + 1] = code
        values[HISTORY] = count

    def _post(self, message: emcy.Emergency) -> None:
        self._waiting.append(message)
        self._flush()

    def _flush(self) -> None:
        cob_id, inhibit_ns = self._store.values[COB_ID], self._store.values[INHIBIT] * 100_000
        if not self.enabled or cob_id & INVALID:
            self._waiting.clear()
        while self._waiting and self._timers.now_ns >= self._not_before_ns:
            self._send(emcy.encode(cob_id, self._waiting.popleft()))
            self._not_before_ns = self._timers.now_ns + inhibit_ns
        if self._waiting:
            self._timers.schedule("emergency", self._not_before_ns, self._flush)

    def _check_history(self, _: Entry, value: Value) -> None:
        if value != 0:  # sub-index 0 takes 0 alone, which clears
            raise SdoError(Abort.VALUE)

    def _clear_history(self) -> None:
        for i in range(ERRORS + 1):
            self._store.values[HISTORY + i] = 0

    def _check_history_read(self, entry: Entry) -> None:
        if entry.sub > self._store.values[HISTORY]:
            raise SdoError(Abort.NO_DATA)

    def _check_cob_id(self, _: Entry, value: Value) -> None:
        new, old = int(value), self._store.values[COB_ID]
        moved = (new ^ old) & ~INVALID
        if new & ~(INVALID | 0x7FF) or nmt.is_restricted(new & 0x7FF):
            raise SdoError(Abort.VALUE)
        if moved and not old & INVALID:  # bits 0 to 29 change only while the object is off
            raise SdoError(Abort.STATE)
