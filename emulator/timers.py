"""What a device has to do later, by name. Time is an argument: nothing here waits."""

from collections.abc import Callable, Hashable

NEVER = 2**63 - 1


class Timers:
    """The present instant and named deadlines, each with an action.

    Attributes:
        now_ns: Time of the call that the device is handling; set by the device.
        next_ns: Earliest deadline; kept at hand because it is asked for in every cycle.
    """

    def __init__(self) -> None:
        self.now_ns = 0
        self._due: dict[Hashable, tuple[int, Callable[[], None]]] = {}
        self.next_ns = NEVER

    def schedule(self, name: Hashable, due_ns: int, action: Callable[[], None]) -> None:
        """Run `action` at `due_ns`; replaces an earlier deadline of that name."""
        self._due[name] = (due_ns, action)
        self._refresh()

    def cancel(self, name: Hashable) -> None:
        if self._due.pop(name, None) is not None:
            self._refresh()

    def pending(self, name: Hashable) -> bool:
        return name in self._due

    def clear(self) -> None:
        self._due.clear()
        self.next_ns = NEVER

    def run(self) -> None:
        """Actions that are due, in order of their deadlines, each at most once."""
        due = sorted((when, n) for n, (name, (when, _)) in enumerate(self._due.items()) if when <= self.now_ns)
        names = list(self._due)
        for _, n in due:
            entry = self._due.get(names[n])
            if entry is not None and entry[0] <= self.now_ns:
                del self._due[names[n]]
                entry[1]()
        self._refresh()

    def _refresh(self) -> None:
        self.next_ns = min((when for when, _ in self._due.values()), default=NEVER)
