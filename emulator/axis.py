"""What the parts of one drive share: sensors, power stage, dictionary, and the reference the axis follows."""

from typing import Any, NamedTuple

from emulator.profile import Profile
from emulator.timers import Timers
from protocols.cia402 import Mode
from protocols.dictionary import PER_MILLE
from protocols.objects import key
from protocols.robot import Drive as DriveConfig

NANO = 1e-9

_POSITION_INTERNAL, POSITION = key(0x6063), key(0x6064)
_VELOCITY = key(0x606C)
_TORQUE, _CURRENT, _CURRENT_MA = key(0x6077), key(0x6078), key(0x2078)
_INPUTS = key(0x60FD)
MAX_TORQUE, MAX_CURRENT = key(0x6072), key(0x6073)
_POSITIVE, _NEGATIVE = key(0x60E0), key(0x60E1)
_LOW, _HIGH = key(0x607D, 1), key(0x607D, 2)
_MAX_VELOCITY, _MAX_SPEED = key(0x607F), key(0x6080)
LIMITS = (0x6072, 0x6073, 0x6080, 0x60E0, 0x60E1)  # objects behind `Axis.take_limits`

NEGATIVE_LIMIT, POSITIVE_LIMIT, HOME_SWITCH = 1, 2, 4  # bits of 0x60FD (CiA 402-2, 15.5)
PROBE_INPUT = 0x1_0000  # bit 16, the first that is the manufacturer's: touch probe 1

_HALF, _FULL = 0x8000_0000, 0xFFFF_FFFF


class Measurement(NamedTuple):
    """What the sensors of one axis read at a SYNC.

    Attributes:
        position: Encoder counts.
        velocity: [counts/s].
        current_A: Mean over the last period.
    """

    position: int
    velocity: int
    current_A: float


class Command(NamedTuple):
    """What the power stage is told.

    Attributes:
        mode: 0 power off and brake engaged, 8 position, 10 current.
        target_position: [counts].
        target_current_A: In mode 10.
    """

    mode: int
    target_position: float
    target_current_A: float


FOLLOW = int(Mode.CSP)  # of `Command.mode`


def clamp32(value: float) -> int:
    return max(-_HALF, min(_HALF - 1, round(value)))


class Axis:
    """State of one axis.

    Attributes:
        values: The dictionary's values.
        period_s: What one step of the reference stands for, the rig's SYNC period.
        position, velocity: Encoder [counts], [counts/s] as latched last.
        zero: Encoder counts at position 0 of the user: homing moves it.
        reference: Where the position controller is sent, in the user's counts.
        following: The power stage is in position control now.
        torque_low, torque_high: Of the motor [per mille].
        fastest: Speed at which torque modes stop accelerating [counts/s].
        travel: Encoder counts at which the limit switches close; None without switches.
        inputs: Digital inputs from outside, bits of 0x60FD.
    """

    def __init__(
        self,
        config: DriveConfig,
        values: dict[int, Any],
        timers: Timers,
        period_s: float,
        travel: tuple[int, int] | None,
    ) -> None:
        self.values = values
        self.timers = timers
        self.period_s = period_s
        self.per_mille = PER_MILLE / config.rated_current_A
        self._most_A = min(0x7FFF / self.per_mille, 2e6)  # what both objects for the current can hold
        self.turn = config.encoder_counts_per_rev
        self.travel = travel
        self.zero = 0
        self.inputs = 0
        self.position = 0
        self.velocity = 0
        self.reference = Profile()
        self.following = False
        self.take_limits()

    def reset(self) -> None:
        """As after power on: an absolute encoder, so only the shift of homing is forgotten."""
        self.zero = 0
        self.following = False
        self.take_limits()

    def latch(self, measurement: Measurement) -> None:
        """Take over what the sensors read."""
        values = self.values
        position, velocity, current_A = measurement
        self.position, self.velocity = position, velocity
        user = position - self.zero
        if -_HALF <= position < _HALF and -_HALF <= user < _HALF and -_HALF <= velocity < _HALF:
            values[_POSITION_INTERNAL], values[POSITION], values[_VELOCITY] = position, user, velocity
        else:  # an encoder counts on from its other end
            values[_POSITION_INTERNAL] = ((position + _HALF) & _FULL) - _HALF
            values[POSITION] = ((user + _HALF) & _FULL) - _HALF
            values[_VELOCITY] = clamp32(velocity)
        if -self._most_A <= current_A <= self._most_A:
            values[_TORQUE] = values[_CURRENT] = round(current_A * self.per_mille)
            values[_CURRENT_MA] = round(1000 * current_A)
        else:
            values[_TORQUE] = values[_CURRENT] = max(-0x8000, min(0x7FFF, round(current_A * self.per_mille)))
            values[_CURRENT_MA] = clamp32(1000 * current_A)
        if self.travel is not None:
            low, high = self.travel
            closed = NEGATIVE_LIMIT if position <= low else POSITIVE_LIMIT if position >= high else 0
            values[_INPUTS] = self.inputs | closed

    @property
    def now_ns(self) -> int:
        return self.timers.now_ns

    @property
    def user_position(self) -> int:
        return self.position - self.zero

    def take_over(self) -> None:
        """Let the reference begin where the axis is and as fast as it moves."""
        position = self.reference.position if self.following else self.user_position
        self.reference.set(position, self.velocity)

    def follow(self) -> Command:
        """Position control along the reference."""
        return Command(FOLLOW, self.reference.position + self.zero, 0.0)

    def off(self) -> Command:
        return Command(0, self.position, 0.0)

    def take_limits(self) -> None:
        """Take over 0x6072, 0x6073, 0x6080, 0x60E0 and 0x60E1."""
        values = self.values
        most = min(values[MAX_TORQUE], values[MAX_CURRENT], 0x7FFF)
        self.torque_high: int = min(most, values[_POSITIVE])
        self.torque_low: int = -min(most, values[_NEGATIVE])
        self.fastest: float = values[_MAX_SPEED] * self.turn / 60  # [counts/s]

    def limit_position(self, position: float) -> float:
        """Within 0x607D; a minimum above the maximum switches the limits off."""
        low, high = self.values[_LOW], self.values[_HIGH]
        if low <= position <= high or low >= high:
            return position
        return float(max(low, min(high, position)))

    def limit_speed(self, speed: float) -> float:
        """Within 0x607F."""
        most: int = self.values[_MAX_VELOCITY]
        return max(-most, min(most, speed))
