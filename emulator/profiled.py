"""Modes in which the drive plans the motion itself: profile position, velocity and torque, homing."""

from emulator.axis import Command
from emulator.homing import HomingRun
from emulator.modes import BIT12, BIT13, LIMITED, REACHED, Mode, TorqueMode, keep_near
from emulator.profile import Settled
from protocols import cia402
from protocols.cia402 import IMMEDIATELY_BIT, RELATIVE_BIT, START_BIT
from protocols.objects import key

_POSITION_WINDOW, _POSITION_TIME = key(0x6067), key(0x6068)
_VELOCITY_WINDOW, _VELOCITY_TIME = key(0x606D), key(0x606E)
_THRESHOLD, _THRESHOLD_TIME = key(0x606F), key(0x6070)
_TARGET_TORQUE, _SLOPE = key(0x6071), key(0x6087)
_TARGET_POSITION = key(0x607A)
_PROFILE_VELOCITY, _ACCELERATION, _DECELERATION = key(0x6081), key(0x6083), key(0x6084)
_TARGET_VELOCITY = key(0x60FF)


class ProfilePosition(Mode):
    """Trapezoidal moves to set-points that bit 4 hands over (CiA 402-2, 10)."""

    code = cia402.Mode.PROFILE_POSITION
    supervised = True

    def start(self) -> None:
        super().start()
        self._target: float | None = None  # of the present motion
        self._next: float | None = None  # handed over while that motion lasts
        self._acknowledged = False
        self._offered = False  # bit 4 is set
        self._limited = False
        self._settled = Settled()
        self._arrived = True

    def control(self, word: int, before: int) -> None:
        super().control(word, before)
        self._offered = bool(word & START_BIT)
        if word & ~before & START_BIT:
            self._take(immediately=bool(word & IMMEDIATELY_BIT), relative=bool(word & RELATIVE_BIT))
        elif not self._offered:
            self._acknowledged = self._next is not None  # 1: there is no room for another

    def _take(self, *, immediately: bool, relative: bool) -> None:
        last = self._next if self._next is not None else self._target
        origin = (self.axis.reference.position if last is None else last) if relative else 0
        wanted = origin + self.axis.values[_TARGET_POSITION]
        target = self.axis.limit_position(wanted)
        if immediately or self._target is None:
            self._target, self._next = target, None
        elif self._next is None:
            self._next = target
        else:
            return
        self._limited = target != wanted
        self._acknowledged = True
        self._arrived = False
        self._settled.clear()

    def step(self) -> None:
        axis, values = self.axis, self.axis.values
        if self.halted or self._target is None:
            self.halt()
        else:
            self._arrived = axis.reference.toward(
                self._target,
                axis.limit_speed(values[_PROFILE_VELOCITY]),
                values[_ACCELERATION],
                values[_DECELERATION],
                axis.period_s,
            )
            if self._arrived and self._next is not None:
                self._target, self._next, self._arrived = self._next, None, False
                self._acknowledged = self._offered
            elif self._arrived:
                error = axis.user_position - self._target
                if self._settled.step(error, values[_POSITION_WINDOW], values[_POSITION_TIME], axis.period_s):
                    self._target = None
        self.report()

    def status(self) -> int:
        reached = not self.axis.reference.velocity if self.halted else self._arrived and self._target is None
        return reached * REACHED | self._acknowledged * BIT12 | self._limited * LIMITED


class ProfileVelocity(Mode):
    """Speeds 0x60FF approached with 0x6083 and 0x6084 (CiA 402-2, 16)."""

    code = cia402.Mode.PROFILE_VELOCITY

    def start(self) -> None:
        super().start()
        self._settled, self._standing = Settled(), Settled()
        self._limited = False

    def step(self) -> None:
        axis, values = self.axis, self.axis.values
        wanted = values[_TARGET_VELOCITY]
        speed = axis.limit_speed(wanted)
        self._limited = speed != wanted
        if self.halted:
            self.halt()
            speed = 0.0
        else:
            axis.reference.at_speed(speed, values[_ACCELERATION], values[_DECELERATION], axis.period_s)
        keep_near(axis)
        self._settled.step(axis.velocity - speed, values[_VELOCITY_WINDOW], values[_VELOCITY_TIME], axis.period_s)
        self._standing.step(axis.velocity, values[_THRESHOLD], values[_THRESHOLD_TIME], axis.period_s)
        self.report()

    def status(self) -> int:
        return self._settled.reached * REACHED | self._standing.reached * BIT12 | self._limited * LIMITED


class ProfileTorque(TorqueMode):
    """Torques 0x6071 approached with the slope 0x6087 (CiA 402-2, 15)."""

    code = cia402.Mode.PROFILE_TORQUE

    def start(self) -> None:
        super().start()
        self._torque = 0.0

    def step(self) -> None:
        values = self.axis.values
        wanted = 0 if self.halted else values[_TARGET_TORQUE]
        most = values[_SLOPE] * self.axis.period_s
        self._torque += max(-most, min(most, wanted - self._torque))

    def demand(self) -> Command:
        return self.make(round(self._torque))

    def status(self) -> int:
        wanted = 0 if self.halted else self.axis.values[_TARGET_TORQUE]
        return (self._torque == wanted) * REACHED | self._limited * LIMITED


class Homing(Mode):
    """Where the zero is (CiA 402-2, 8); bit 4 starts it."""

    code = cia402.Mode.HOMING
    supervised = True

    def start(self) -> None:
        super().start()
        self._run: HomingRun | None = None
        self._attained = self._failed = False

    def control(self, word: int, before: int) -> None:
        super().control(word, before)
        if word & ~before & START_BIT:
            self._attained = self._failed = False
            self._run = HomingRun.begin(self.axis)
            self._failed = self._run is None
        elif not word & START_BIT and self._run is not None:
            self._run = None

    def step(self) -> None:
        if self._run is None or self.halted:
            self.halt()
        elif self._run.step():
            self._run = None
            self._attained = True
        elif self._run.failed:
            self._run = None
            self._failed = True
        self.report()

    def status(self) -> int:
        standing = (not self.axis.reference.velocity and self._run is None) or self.halted
        return standing * REACHED | self._attained * BIT12 | self._failed * BIT13
