"""How a drive comes to rest: ramps of the option codes, and the time a holding brake needs."""

from emulator.axis import Axis
from protocols.cia402 import State
from protocols.objects import Value, key
from protocols.sdo import Abort, SdoError

BRAKE_DELAY_NS = 50_000_000  # from standstill to power off; holding brakes of this size close in 30 to 80 ms

QUICK_STOP, SHUTDOWN, DISABLE, HALT = key(0x605A), key(0x605B), key(0x605C), key(0x605D)
FAULT_REACTION = key(0x605E)

_SLOW_DOWN, _QUICK = key(0x6084), key(0x6085)
_RAMP = {1: _SLOW_DOWN, 2: _QUICK, 5: _SLOW_DOWN, 6: _QUICK}  # deceleration by option; 0 cuts the power
_HOLDING = (5, 6)  # stay in QUICK_STOP_ACTIVE after the ramp

_ALLOWED = {  # by index; ramps at the limits of current and voltage are not offered
    0x605A: (0, 1, 2, 5, 6),
    0x605B: (0, 1),
    0x605C: (0, 1),
    0x605D: (1, 2),
    0x605E: (0, 1, 2),
}
OPTIONS = tuple(_ALLOWED)


def check_option(index: int, value: Value) -> None:
    """Refuse an option code that the drive does not have.

    Raises:
        SdoError: The value is not allowed.
    """
    if value not in _ALLOWED[index]:
        raise SdoError(Abort.VALUE)


class Stop:
    """An axis on its way to rest under position control, then held until its brake has closed.

    Attributes:
        then: State of the drive after that; None: the position is held on.
    """

    def __init__(self, axis: Axis, option: int, then: State | None) -> None:
        """Begin with the present motion.

        Args:
            option: 1, 2, 5 or 6 of 0x605A and its like.
        """
        axis.take_over()
        self._axis = axis
        self._rate = _RAMP[option]
        self._held_ns = 0
        self._resting = False
        self.then = None if option in _HOLDING else then

    def step(self) -> None:
        """Go on for a period."""
        axis = self._axis
        if self._resting:
            self._held_ns += round(1e9 * axis.period_s)
        else:
            rate = axis.values[self._rate]
            rest_s = abs(axis.reference.velocity) / rate
            self._resting = axis.reference.stop(rate, axis.period_s)
            if self._resting:
                self._held_ns = round(1e9 * (axis.period_s - rest_s))

    @property
    def over(self) -> bool:
        """The brake has closed."""
        return self._resting and self._held_ns >= BRAKE_DELAY_NS


def at_rest(axis: Axis, option: int) -> bool:
    """Whether a ramp would end within one period."""
    rate: int = axis.values[_RAMP[option]]
    return abs(axis.velocity) <= rate * axis.period_s
