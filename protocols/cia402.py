"""The drive profile CiA 402-2: states, commands, transitions, and the words that carry them."""

from collections.abc import Iterable, Mapping
from enum import Enum, IntEnum, IntFlag


class State(Enum):
    """States of the power drive system (CiA 402-2, figure 4).

    Attributes:
        mask, pattern: A statusword `w` reports the state when `w & mask == pattern` (table 29).
    """

    NOT_READY_TO_SWITCH_ON = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION_ACTIVE = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)

    __hash__ = object.__hash__  # by identity: states are keys in code that runs with every SYNC

    @property
    def mask(self) -> int:
        return self.value[0]

    @property
    def pattern(self) -> int:
        return self.value[1]


class Command(Enum):
    """Commands of the controlword. `SWITCH_ON` is also *disable operation*: the bits are the same."""

    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch on"
    ENABLE_OPERATION = "enable operation"
    DISABLE_VOLTAGE = "disable voltage"
    QUICK_STOP = "quick stop"
    FAULT_RESET = "fault reset"


class Event(Enum):
    """What moves a drive without a command."""

    INITIALISED = "initialised"
    FAULT = "fault"
    REACTION_DONE = "reaction done"


_S, _C, _E = State, Command, Event

TRANSITIONS: Mapping[tuple[State, Command | Event], State] = {
    (_S.NOT_READY_TO_SWITCH_ON, _E.INITIALISED): _S.SWITCH_ON_DISABLED,  # 1
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 2
    (_S.READY_TO_SWITCH_ON, _C.SWITCH_ON): _S.SWITCHED_ON,  # 3
    (_S.READY_TO_SWITCH_ON, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 3 and, by itself, 4
    (_S.SWITCHED_ON, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 4
    (_S.OPERATION_ENABLED, _C.SWITCH_ON): _S.SWITCHED_ON,  # 5
    (_S.SWITCHED_ON, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 6
    (_S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 7
    (_S.READY_TO_SWITCH_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 7
    (_S.OPERATION_ENABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 8
    (_S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 9
    (_S.SWITCHED_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 10
    (_S.SWITCHED_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 10
    (_S.OPERATION_ENABLED, _C.QUICK_STOP): _S.QUICK_STOP_ACTIVE,  # 11
    (_S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 12
    **{(s, _E.FAULT): _S.FAULT_REACTION_ACTIVE for s in _S if s not in {_S.FAULT, _S.FAULT_REACTION_ACTIVE}},  # 13
    (_S.FAULT_REACTION_ACTIVE, _E.REACTION_DONE): _S.FAULT,  # 14
    (_S.FAULT, _C.FAULT_RESET): _S.SWITCH_ON_DISABLED,  # 15
    (_S.QUICK_STOP_ACTIVE, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 16, only where 0x605A holds the stop
}

# --- controlword ---

FAULT_RESET_BIT = 0x80
HALT_BIT = 0x100
START_BIT = 0x10  # profile position: new set-point; homing: start; interpolated position: enable
IMMEDIATELY_BIT = 0x20  # profile position: do not wait for the end of the present motion
RELATIVE_BIT = 0x40  # profile position

_COMMANDS = (  # mask and value of bits 7, 3, 2, 1, 0 (CiA 402-2, table 27)
    (0x82, 0x00, Command.DISABLE_VOLTAGE),
    (0x86, 0x02, Command.QUICK_STOP),
    (0x87, 0x06, Command.SHUTDOWN),
    (0x8F, 0x07, Command.SWITCH_ON),
    (0x8F, 0x0F, Command.ENABLE_OPERATION),
)


def _decode(controlword: int) -> Command | None:
    return next((command for mask, value, command in _COMMANDS if controlword & mask == value), None)


_BY_LOW_BYTE = tuple(_decode(low) for low in range(256))


def decode_controlword(controlword: int, previous: int) -> Command | None:
    """Command of a controlword.

    Args:
        previous: The controlword before it: a fault is reset by the rising edge of bit 7 alone.

    Returns:
        None where bit 7 stays set: it masks every command.
    """
    if controlword & ~previous & FAULT_RESET_BIT:
        return Command.FAULT_RESET
    return _BY_LOW_BYTE[controlword & 0xFF]


CONTROLWORD: Mapping[Command, int] = {
    Command.SHUTDOWN: 0x06,
    Command.SWITCH_ON: 0x07,
    Command.ENABLE_OPERATION: 0x0F,
    Command.DISABLE_VOLTAGE: 0x00,
    Command.QUICK_STOP: 0x02,
    Command.FAULT_RESET: FAULT_RESET_BIT,
}

_TOWARDS_ENABLED: Mapping[State, Command] = {
    State.SWITCH_ON_DISABLED: Command.SHUTDOWN,
    State.READY_TO_SWITCH_ON: Command.SWITCH_ON,
    State.SWITCHED_ON: Command.ENABLE_OPERATION,
    State.OPERATION_ENABLED: Command.ENABLE_OPERATION,
    State.QUICK_STOP_ACTIVE: Command.DISABLE_VOLTAGE,
    State.FAULT: Command.FAULT_RESET,
}


def controlword_to_enable(state: State, previous: int) -> int:
    """What a master sends next on the way to OPERATION_ENABLED.

    Args:
        previous: The controlword sent before. In FAULT the answer alternates between 0 and bit 7: its edge counts.
    """
    if state not in _TOWARDS_ENABLED:  # the drive moves by itself
        return CONTROLWORD[Command.DISABLE_VOLTAGE]
    word = CONTROLWORD[_TOWARDS_ENABLED[state]]
    return word & ~previous if state is State.FAULT else word


# --- statusword ---


class Status(IntFlag):
    """Bits of the statusword beside the state's own (CiA 402-2, table 28). Bits 12 and 13 mean what the mode says."""

    VOLTAGE_ENABLED = 0x0010
    WARNING = 0x0080
    REMOTE = 0x0200
    TARGET_REACHED = 0x0400
    INTERNAL_LIMIT = 0x0800
    FOLLOWS_COMMAND = 0x1000  # CSP, CSV, CST
    SETPOINT_ACKNOWLEDGE = 0x1000  # profile position
    SPEED_ZERO = 0x1000  # profile velocity
    HOMING_ATTAINED = 0x1000
    INTERPOLATING = 0x1000  # interpolated position
    FOLLOWING_ERROR = 0x2000  # position modes
    HOMING_ERROR = 0x2000


def state_of(statusword: int) -> State | None:
    """State that a statusword reports; None for a pattern the profile does not know."""
    return next((s for s in State if statusword & s.mask == s.pattern), None)


# --- modes of operation ---


class Mode(IntEnum):
    """Modes of operation, objects 0x6060 and 0x6061 (CiA 402-2, table 80)."""

    NONE = 0
    PROFILE_POSITION = 1
    PROFILE_VELOCITY = 3
    PROFILE_TORQUE = 4
    HOMING = 6
    INTERPOLATED_POSITION = 7
    CSP = 8
    CSV = 9
    CST = 10


SUPPORTED = tuple(mode for mode in Mode if mode is not Mode.NONE)


def supported_modes(modes: Iterable[Mode]) -> int:
    """Value of 0x6502: bit n - 1 stands for mode n."""
    return sum(1 << (mode - 1) for mode in modes)


class Homing(IntEnum):
    """Homing methods, object 0x6098 (CiA 402-2, 8.3), that armrig's drives have."""

    NONE = 0
    NEGATIVE_LIMIT_AND_INDEX = 1
    POSITIVE_LIMIT_AND_INDEX = 2
    NEGATIVE_LIMIT = 17
    POSITIVE_LIMIT = 18
    NEGATIVE_INDEX = 33
    POSITIVE_INDEX = 34
    CURRENT_POSITION_OLD = 35
    CURRENT_POSITION = 37
