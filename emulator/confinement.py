"""Fault confinement of one CAN controller: error counters, error passive, bus-off (ISO 11898-1, 10.13)."""

from protocols.errorframes import Class, State, Status, encode
from protocols.frames import Frame

WARNING_LIMIT = 96  # Linux and every common controller
PASSIVE_LIMIT = 128
BUS_OFF_LIMIT = 256
_LEVELS = ((PASSIVE_LIMIT, State.PASSIVE), (WARNING_LIMIT, State.WARNING))


class Confinement:
    """Counters and state of one controller, and the error frames its host is told.

    Args:
        number: Which of several controllers behind one interface, for the error frames.

    Attributes:
        tec, rec: Transmit and receive error counters.
        state: What follows from them.
    """

    def __init__(self, number: int = 0) -> None:
        self.number = number
        self.tec = self.rec = 0
        self.state = State.ACTIVE

    def sent(self) -> Frame | None:
        """A frame went through. Returns what the host is told, where the state has changed."""
        if not self.tec:
            return None
        self.tec -= 1
        return self._review()

    def received(self) -> Frame | None:
        """A frame of somebody else went through."""
        if not self.rec:
            return None
        self.rec = 127 if self.rec >= PASSIVE_LIMIT else self.rec - 1  # the standard: to between 119 and 127
        return self._review()

    def failed_to_send(self, *, unacknowledged: bool = False) -> Frame | None:
        """A frame of ours met an error. A passive controller does not count missing acknowledgements."""
        if not (unacknowledged and self.state is State.PASSIVE):
            self.tec += 8
        return self._review()

    def failed_to_receive(self) -> Frame | None:
        """A frame of somebody else met an error."""
        self.rec = min(self.rec + 1, PASSIVE_LIMIT)
        return self._review()

    def bus_off(self) -> Frame:
        """Leave the bus at once, whatever the counters were."""
        self.tec, self.state = BUS_OFF_LIMIT, State.BUS_OFF
        return encode(Class.BUS_OFF, tec=255, rec=self.rec, station=self.number)

    def restart(self) -> Frame:
        """Come back with clean counters."""
        self.tec = self.rec = 0
        self.state = State.ACTIVE
        return encode(Class.RESTARTED, tec=0, rec=0, station=self.number)

    def _review(self) -> Frame | None:
        worst = max(self.tec, self.rec)
        if self.tec >= BUS_OFF_LIMIT:
            return None if self.state is State.BUS_OFF else self.bus_off()
        state = next((state for limit, state in _LEVELS if worst >= limit), State.ACTIVE)
        if state is self.state:
            return None
        self.state = state
        status = {
            State.ACTIVE: Status.ACTIVE,
            State.WARNING: Status.TX_WARNING if self.tec >= WARNING_LIMIT else Status.RX_WARNING,
            State.PASSIVE: Status.TX_PASSIVE if self.tec >= PASSIVE_LIMIT else Status.RX_PASSIVE,
        }[state]
        return encode(Class.CONTROLLER, status, tec=self.tec, rec=self.rec, station=self.number)
