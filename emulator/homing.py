"""Homing methods (CiA 402-2, 8.3): moves to a limit switch or an index pulse, and the zero they define.

The encoder gives one index pulse per motor revolution, at multiples of its counts. Limit switches close at the ends
of the axis' travel.
"""

from typing import Self

from emulator.axis import NEGATIVE_LIMIT, POSITIVE_LIMIT, Axis
from protocols.cia402 import Homing
from protocols.objects import key

_INPUTS = key(0x60FD)
_OFFSET, _METHOD = key(0x607C), key(0x6098)
_SWITCH_SPEED, _ZERO_SPEED, _ACCELERATION = key(0x6099, 1), key(0x6099, 2), key(0x609A)

# Method: direction and switch of the first move (0: none), then whether an index pulse has to be found.
_SEARCH = {
    Homing.NEGATIVE_LIMIT_AND_INDEX: (-1, NEGATIVE_LIMIT, True),
    Homing.POSITIVE_LIMIT_AND_INDEX: (1, POSITIVE_LIMIT, True),
    Homing.NEGATIVE_LIMIT: (-1, NEGATIVE_LIMIT, False),
    Homing.POSITIVE_LIMIT: (1, POSITIVE_LIMIT, False),
    Homing.NEGATIVE_INDEX: (-1, 0, True),
    Homing.POSITIVE_INDEX: (1, 0, True),
}
_AT_ONCE = (Homing.CURRENT_POSITION_OLD, Homing.CURRENT_POSITION)
METHODS = (Homing.NONE, *_SEARCH, *_AT_ONCE)


def index_passed(before: int, after: int, turn: int) -> int | None:
    """Counts at which an index pulse was passed between two readings; None where none was."""
    if after == before:
        return None
    pulse = after // turn * turn if after > before else -(-after // turn) * turn
    return pulse if min(before, after) <= pulse <= max(before, after) and pulse != before else None


class HomingRun:
    """One homing in progress; `step` it once per period.

    Attributes:
        failed: It cannot succeed any more.
    """

    def __init__(self, axis: Axis, direction: int, switch: int, *, with_index: bool) -> None:
        self._axis = axis
        self._direction = direction
        self._switch = switch
        self._with_index = with_index
        self._leaving = False  # the switch was found; the zero is on the way back
        self._zero: int | None = None
        self._before = axis.position
        self.failed = False

    @classmethod
    def begin(cls, axis: Axis) -> Self | None:
        """Start the method of 0x6098; None where the axis cannot do it."""
        method = axis.values[_METHOD]
        if method in _AT_ONCE:
            run = cls(axis, 0, 0, with_index=False)
            run._zero = axis.position
            return run
        if method not in _SEARCH:
            return None
        direction, switch, with_index = _SEARCH[method]
        if switch and axis.travel is None:
            return None
        return cls(axis, direction, switch, with_index=with_index)

    def step(self) -> bool:
        """Go on for a period; true when the zero is where it belongs and the axis at rest."""
        axis, values = self._axis, self._axis.values
        acceleration = values[_ACCELERATION]
        if self._zero is None:
            searching = bool(self._switch) and not self._leaving
            speed = values[_SWITCH_SPEED if searching else _ZERO_SPEED]
            axis.reference.at_speed(self._direction * speed, acceleration, acceleration, axis.period_s)
            self._look(searching=searching)
            self._before = axis.position
        elif axis.reference.stop(acceleration, axis.period_s):
            self._define(self._zero)
            return True
        return False

    def _look(self, *, searching: bool) -> None:
        axis = self._axis
        closed = axis.values[_INPUTS]
        if searching:
            if closed & self._switch:
                self._leaving = True
                self._direction = -self._direction
            return
        if self._leaving:
            if closed & self._switch:
                return
            if not self._with_index:
                self._zero = axis.position
                return
        ahead = POSITIVE_LIMIT if self._direction > 0 else NEGATIVE_LIMIT
        self._zero = index_passed(self._before, axis.position, axis.turn)
        self.failed = self._zero is None and bool(closed & ahead)

    def _define(self, zero: int) -> None:
        """The position at `zero` becomes 0x607C (CiA 402-2, 8.4.2)."""
        axis = self._axis
        moved = axis.zero
        axis.zero = zero - axis.values[_OFFSET]
        axis.reference.position += moved - axis.zero
