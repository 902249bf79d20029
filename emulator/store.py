"""Values behind a device's dictionary, guarded as SDO access has to be, and its memory for the time without power."""

from collections.abc import Callable
from typing import Any

from protocols.dictionary import SIGNATURE_LOAD, SIGNATURE_SAVE
from protocols.objects import Dictionary, Entry, Value, key
from protocols.sdo import Abort, SdoError

_COMMANDS = (0x1010, 0x1011)  # writing them does something; what they read as stays

Guard = Callable[[Entry, Value], None]

_AREAS = {  # by sub-index of 0x1010 and 0x1011: first and last index
    1: (0x1000, 0xFFFF),
    2: (0x1000, 0x1FFF),
    3: (0x6000, 0x9FFF),
    4: (0x2000, 0x5FFF),
}


class ObjectStore:
    """Values by `objects.key`, with the checks and consequences of writing them.

    Attributes:
        values: The device's own code reads and writes here, unchecked; one flat dictionary, because TPDOs are packed
            from it a thousand times a second.
        saved: What 0x1010 has stored, by key; it takes the place of the defaults.
    """

    def __init__(self, dictionary: Dictionary, node_id: int) -> None:
        self.dictionary = dictionary
        self.values: dict[int, Any] = dict(dictionary.defaults(node_id))
        self._defaults = dict(self.values)
        self.saved: dict[int, Any] = {}
        self._forgotten: dict[int, Any] = {}  # saved values that 0x1011 drops at the next reset
        self._sources: dict[int, Callable[[], bytes]] = {}
        self._guards: dict[int, Guard] = {}
        self._read_guards: dict[int, Callable[[Entry], None]] = {}
        self._consequences: dict[int, Callable[[], None]] = {}
        self.guard(0x1010, self._save)
        self.guard(0x1011, self._load)

    def guard(self, index: int, guard: Guard | None = None, consequence: Callable[[], None] | None = None) -> None:
        """Watch an object.

        Args:
            guard: Called before a value is stored; raises `SdoError` to refuse it.
            consequence: Called after a value was stored.
        """
        if guard is not None:
            self._guards[index] = guard
        if consequence is not None:
            self._consequences[index] = consequence

    def guard_read(self, index: int, guard: Callable[[Entry], None]) -> None:
        """As `guard`, before a value is read over the bus."""
        self._read_guards[index] = guard

    def provide(self, index: int, source: Callable[[], bytes]) -> None:
        """Where the bytes of a DOMAIN come from."""
        self._sources[index] = source

    def watched(self, entry: Entry) -> bool:
        """Whether writing the entry takes more than storing a value."""
        return (
            entry.low is not None
            or entry.high is not None
            or entry.index in self._guards
            or entry.index in self._consequences
        )

    def restore(self, first: int, last: int) -> None:
        """Power-on values of the objects with these indices, without checks or consequences."""
        low, high = key(first), key(last, 0xFF)
        for k in [k for k in self._forgotten if low <= k <= high]:
            del self._forgotten[k]
            self.saved.pop(k, None)
        values = self._defaults | self.saved
        self.values.update((k, v) for k, v in values.items() if low <= k <= high)

    def rebase(self, node_id: int) -> None:
        """Defaults of another node-id."""
        self._defaults = self._defaults | {
            k: v for k, v in self.dictionary.defaults(node_id).items() if self.dictionary.entries[k].node_relative
        }

    def make_default(self, index: int, sub: int, value: Value) -> None:
        """A default that only this device has, such as its serial number."""
        self._defaults[key(index, sub)] = self.values[key(index, sub)] = value

    def _save(self, entry: Entry, value: Value) -> None:
        """0x1010: store the settings of an area (CiA 301, 7.5.2.13)."""
        first, last = self._area(entry, value, SIGNATURE_SAVE)
        for k, e in self.dictionary.entries.items():
            if e.access == "rw" and not e.volatile and first <= e.index <= last:
                self.saved[k] = self.values[k]
                self._forgotten.pop(k, None)

    def _load(self, entry: Entry, value: Value) -> None:
        """0x1011: have the defaults back from the next reset on."""
        first, last = self._area(entry, value, SIGNATURE_LOAD)
        self._forgotten.update((k, v) for k, v in self.saved.items() if first <= k >> 8 <= last)

    @staticmethod
    def _area(entry: Entry, value: Value, signature: int) -> tuple[int, int]:
        if value != signature:
            raise SdoError(Abort.NOT_STORED)
        return _AREAS[entry.sub]

    def put(self, entry: Entry, value: Value) -> None:
        """Store a value that came over the bus.

        Raises:
            SdoError: It is refused.
        """
        entry.check(value)
        guard = self._guards.get(entry.index)
        if guard is not None:
            guard(entry, value)
        if entry.index not in _COMMANDS:
            self.values[entry.key] = value
        consequence = self._consequences.get(entry.index)
        if consequence is not None:
            consequence()

    # --- protocols.sdo.Objects ---

    def read(self, index: int, sub: int) -> bytes:
        entry = self.dictionary.find(index, sub)
        if not entry.readable:
            raise SdoError(Abort.WRITE_ONLY, index, sub)
        if index in self._read_guards:
            self._read_guards[index](entry)
        if index in self._sources:
            return self._sources[index]()
        return entry.encode(self.values[entry.key])

    def sizes(self, index: int, sub: int) -> tuple[int, int]:
        entry = self.dictionary.find(index, sub)
        if not entry.writable:
            raise SdoError(Abort.READ_ONLY, index, sub)
        return entry.sizes

    def write(self, index: int, sub: int, data: bytes) -> None:
        entry = self.dictionary.find(index, sub)
        self.put(entry, entry.decode(data))
