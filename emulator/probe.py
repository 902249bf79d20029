"""Touch probe 1 (CiA 402-2, 9): the position at an edge of an input or at an index pulse of the encoder."""

from emulator.axis import PROBE_INPUT, Axis
from emulator.homing import index_passed
from protocols.objects import key

FUNCTION = key(0x60B8)
_STATUS, _RISING, _FALLING = key(0x60B9), key(0x60BA), key(0x60BB)

_ENABLE, _CONTINUOUS, _INDEX = 0x01, 0x02, 0x04  # of 0x60B8
_ON_RISING, _ON_FALLING = 0x10, 0x20
_ENABLED, _HAS_RISING, _HAS_FALLING = 0x01, 0x02, 0x04  # of 0x60B9


class TouchProbe:
    """Probe 1; probe 2 does not exist. Sampled once per period, index pulses are exact all the same."""

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self.reset()

    def reset(self) -> None:
        self.active = False
        self._before = 0
        self._level = False

    def configure(self) -> None:
        """0x60B8 was written: switching the probe off clears its status, on arms it anew."""
        values = self._axis.values
        self.active = bool(values[FUNCTION] & _ENABLE)
        values[_STATUS] = _ENABLED if self.active else 0
        self._before = self._axis.position
        self._level = bool(self._axis.inputs & PROBE_INPUT)

    def step(self) -> None:
        """A new measurement is there."""
        axis = self._axis
        function = axis.values[FUNCTION]
        if function & _INDEX:
            pulse = index_passed(self._before, axis.position, axis.turn)
            self._before = axis.position
            if pulse is not None:  # a pulse has both edges at one count
                self._store(function & _ON_RISING, _HAS_RISING, _RISING, pulse)
                self._store(function & _ON_FALLING, _HAS_FALLING, _FALLING, pulse)
            return
        level = bool(axis.inputs & PROBE_INPUT)
        if level and not self._level:
            self._store(function & _ON_RISING, _HAS_RISING, _RISING, axis.position)
        elif self._level and not level:
            self._store(function & _ON_FALLING, _HAS_FALLING, _FALLING, axis.position)
        self._level = level

    def _store(self, wanted: int, seen: int, where: int, counts: int) -> None:
        values = self._axis.values
        if wanted and (values[FUNCTION] & _CONTINUOUS or not values[_STATUS] & seen):
            values[_STATUS] |= seen
            values[where] = ((counts - self._axis.zero + 0x8000_0000) & 0xFFFF_FFFF) - 0x8000_0000
