"""Modes whose targets come with every cycle of the master: CSP, CSV, CST and interpolated position."""

from emulator.axis import Axis, Command, clamp32
from emulator.modes import BIT12, FOLLOWS_LIMITED, LIMITED, REACHED, Mode, TorqueMode, keep_near
from protocols import cia402
from protocols.cia402 import START_BIT
from protocols.objects import key

_POSITION_DEMAND = key(0x6062)
_TARGET_TORQUE = key(0x6071)
_TARGET_POSITION = key(0x607A)
_POSITION_OFFSET, _VELOCITY_OFFSET, _TORQUE_OFFSET = key(0x60B0), key(0x60B1), key(0x60B2)
_SETPOINT = key(0x60C1, 1)
_INTERPOLATION_VALUE, _INTERPOLATION_INDEX = key(0x60C2, 1), key(0x60C2, 2)
_TARGET_VELOCITY = key(0x60FF)


class _Interpolator:
    """Straight lines between set-points that come every 0x60C2."""

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self._target: float | None = None
        self._left = 0

    def step(self, target: float) -> None:
        """One period on the way to a set-point."""
        axis = self._axis
        reference = axis.reference
        if target != self._target:
            self._target = target
            value, index = axis.values[_INTERPOLATION_VALUE], axis.values[_INTERPOLATION_INDEX]
            self._left = max(1, round(value * 10.0**index / axis.period_s))
        if self._left > 1:
            target = reference.position + (target - reference.position) / self._left
            self._left -= 1
        reference.velocity = (target - reference.position) / axis.period_s
        reference.position = target


class CyclicPosition(Mode):
    """0x607A plus 0x60B0 by the end of 0x60C2 (CiA 402-2, 12)."""

    code = cia402.Mode.CSP
    supervised = True

    def start(self) -> None:
        super().start()
        self._path = _Interpolator(self.axis)
        self._limited = False

    def step(self) -> None:
        values = self.axis.values
        wanted = values[_TARGET_POSITION] + values[_POSITION_OFFSET]
        target = self.axis.limit_position(wanted)
        self._limited = target != wanted
        self._path.step(target)
        values[_POSITION_DEMAND] = clamp32(self.axis.reference.position)

    def status(self) -> int:
        return FOLLOWS_LIMITED if self._limited else BIT12


class InterpolatedPosition(Mode):
    """Set-points 0x60C1 while bit 4 is set; at rest without (CiA 402-2, 11)."""

    code = cia402.Mode.INTERPOLATED_POSITION
    supervised = True

    def start(self) -> None:
        super().start()
        self._path = _Interpolator(self.axis)
        self._running = False
        self._limited = False

    def control(self, word: int, before: int) -> None:
        super().control(word, before)
        self._running = bool(word & START_BIT)

    def step(self) -> None:
        if self._running and not self.halted:
            wanted = self.axis.values[_SETPOINT]
            target = self.axis.limit_position(wanted)
            self._limited = target != wanted
            self._path.step(target)
        else:
            self.halt()
            self._path = _Interpolator(self.axis)
        self.report()

    def status(self) -> int:
        active = self._running and not self.halted
        standing = not active and not self.axis.reference.velocity
        return active * BIT12 | standing * REACHED | self._limited * LIMITED


class CyclicVelocity(Mode):
    """0x60FF plus 0x60B1, as they are (CiA 402-2, 13)."""

    code = cia402.Mode.CSV

    def start(self) -> None:
        super().start()
        self._limited = False

    def step(self) -> None:
        axis, values = self.axis, self.axis.values
        wanted = values[_TARGET_VELOCITY] + values[_VELOCITY_OFFSET]
        speed = axis.limit_speed(wanted)
        self._limited = speed != wanted
        reference = axis.reference
        reference.position += speed * axis.period_s
        reference.velocity = speed
        keep_near(axis)
        self.report()

    def status(self) -> int:
        return FOLLOWS_LIMITED if self._limited else BIT12


class CyclicTorque(TorqueMode):
    """0x6071 plus 0x60B2, as they are (CiA 402-2, 14)."""

    code = cia402.Mode.CST

    def step(self) -> None:
        """A torque has no reference to move."""

    def demand(self) -> Command:
        return self.make(self.axis.values[_TARGET_TORQUE] + self.axis.values[_TORQUE_OFFSET])

    def status(self) -> int:
        return FOLLOWS_LIMITED if self._limited else BIT12
