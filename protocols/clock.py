"""Time for the outer loops. Cores never read a clock: they get `t_ns`, nanoseconds since the run started."""

import time
from typing import Protocol


class Clock(Protocol):
    """What an outer loop needs of time."""

    def now_ns(self) -> int:
        """Nanoseconds since the clock was made."""

    def sleep_until(self, t_ns: int) -> int:
        """Wait for an absolute time; returns by how many nanoseconds it was missed (0 or more)."""


class RealClock:
    """The machine's monotonic clock.

    A plain sleep to an absolute deadline: measured as good as spinning, and it leaves the core to the others.
    """

    def __init__(self) -> None:
        self._start = time.monotonic_ns()

    def now_ns(self) -> int:
        return time.monotonic_ns() - self._start

    def sleep_until(self, t_ns: int) -> int:
        wait = t_ns - self.now_ns()
        if wait > 0:
            time.sleep(wait * 1e-9)
        return max(0, self.now_ns() - t_ns)


class SimClock:
    """Simulated time: waiting costs nothing."""

    def __init__(self) -> None:
        self._now = 0

    def now_ns(self) -> int:
        return self._now

    def sleep_until(self, t_ns: int) -> int:
        self._now = max(self._now, t_ns)
        return 0


def utc_now_ns() -> int:
    """Date [ns since 1970], for `RunStart` and python-can messages: all else counts from the run's start."""
    return time.time_ns()
