"""Modes of operation of a drive (CiA 402-2): what it makes of targets and of the mode's own bits.

The power stage knows two things, to follow a position and to make a current. Every mode that moves by itself moves
the axis' reference, one step per SYNC period of the rig, and lets the power stage follow it.
"""

from abc import ABC, abstractmethod
from typing import ClassVar

from emulator.axis import Axis, Command, clamp32
from protocols import cia402
from protocols.cia402 import HALT_BIT, Status
from protocols.objects import key

_HALT_OPTION = key(0x605D)
_POSITION_DEMAND = key(0x6062)
_VELOCITY_DEMAND = key(0x606B)
_TORQUE_DEMAND = key(0x6074)
_DECELERATION = key(0x6084)
_QUICK_STOP = key(0x6085)
_WINDOW = key(0x6065)

# Plain numbers for the code that runs with every SYNC: flags of the enum module cost a microsecond each.
REACHED, LIMITED = int(Status.TARGET_REACHED), int(Status.INTERNAL_LIMIT)
_DRIVE = int(cia402.Mode.CST)
BIT12, BIT13 = int(Status.FOLLOWS_COMMAND), int(Status.FOLLOWING_ERROR)
FOLLOWS_LIMITED = BIT12 | LIMITED


class Mode(ABC):
    """One mode of one axis.

    Attributes:
        code: Of 0x6060.
        supervised: The axis must stay near the reference (0x6065).
    """

    code: ClassVar[cia402.Mode]
    supervised: ClassVar[bool] = False

    def __init__(self, axis: Axis) -> None:
        self.axis = axis
        self.halted = False

    def start(self) -> None:
        """The mode becomes active on an enabled drive, or the drive becomes enabled in it."""
        self.axis.take_over()

    def control(self, word: int, before: int) -> None:
        """A controlword has come while the mode is active."""
        self.halted = bool(word & HALT_BIT)

    @abstractmethod
    def step(self) -> None:
        """The rig's next period begins."""

    def demand(self) -> Command:
        """What the power stage does in it."""
        return self.axis.follow()

    @abstractmethod
    def status(self) -> int:
        """Bits 10 to 13 of the statusword."""

    def halt(self) -> bool:
        """Slow down as 0x605D says; true at rest."""
        values = self.axis.values
        rate = values[_QUICK_STOP if values[_HALT_OPTION] == 2 else _DECELERATION]
        return self.axis.reference.stop(rate, self.axis.period_s)

    def report(self) -> None:
        """Show the reference in 0x6062 and 0x606B."""
        reference = self.axis.reference
        self.axis.values[_POSITION_DEMAND] = clamp32(reference.position)
        self.axis.values[_VELOCITY_DEMAND] = clamp32(reference.velocity)


class TorqueMode(Mode):
    """What torque modes share: limits of torque and, by 0x6080, of speed."""

    def start(self) -> None:
        self._limited = False

    def make(self, wanted: int) -> Command:
        """Command for a torque [per mille]."""
        axis = self.axis
        applied = wanted
        if applied > axis.torque_high:
            applied = axis.torque_high
        elif applied < axis.torque_low:
            applied = axis.torque_low
        if applied * axis.velocity > 0 and abs(axis.velocity) > axis.fastest:
            applied = 0
        self._limited = applied != wanted
        axis.values[_TORQUE_DEMAND] = applied
        return Command(_DRIVE, axis.position, applied / axis.per_mille)


def keep_near(axis: Axis) -> None:
    """Keep the integral of a speed within the following error window of the axis: one that is blocked must not
    catch up at any speed once it is free."""
    window = axis.values[_WINDOW]
    near = axis.user_position
    axis.reference.position = max(near - window, min(near + window, axis.reference.position))
