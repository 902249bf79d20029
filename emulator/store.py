"""The values behind a device's dictionary, guarded as SDO access has to be."""

from collections.abc import Callable
from typing import Any

from protocols.objects import Dictionary, Entry, Value, key
from protocols.sdo import Abort, SdoError

Guard = Callable[[Entry, Value], None]


class ObjectStore:
    """Values by `objects.key`, with the checks and consequences of writing them.

    Attributes:
        values: The device's own code reads and writes here, unchecked; one flat dictionary, because TPDOs are packed
            from it a thousand times a second.
    """

    def __init__(self, dictionary: Dictionary, node_id: int) -> None:
        self.dictionary = dictionary
        self.values: dict[int, Any] = dict(dictionary.defaults(node_id))
        self._defaults = dict(self.values)
        self._guards: dict[int, Guard] = {}
        self._read_guards: dict[int, Callable[[Entry], None]] = {}
        self._consequences: dict[int, Callable[[], None]] = {}

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
        self.values.update((k, v) for k, v in self._defaults.items() if low <= k <= high)

    def put(self, entry: Entry, value: Value) -> None:
        """Store a value that came over the bus.

        Raises:
            SdoError: It is refused.
        """
        entry.check(value)
        guard = self._guards.get(entry.index)
        if guard is not None:
            guard(entry, value)
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
        return entry.encode(self.values[entry.key])

    def sizes(self, index: int, sub: int) -> tuple[int, int]:
        entry = self.dictionary.find(index, sub)
        if not entry.writable:
            raise SdoError(Abort.READ_ONLY, index, sub)
        return entry.sizes

    def write(self, index: int, sub: int, data: bytes) -> None:
        entry = self.dictionary.find(index, sub)
        self.put(entry, entry.decode(data))
