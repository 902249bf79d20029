"""CiA 402 servo drive of one axis: the device on the bus, between the master's targets and the arm's current loop.

How it stops. A quick stop (0x605A) and the reaction to a fault (0x605E) either cut the power at once (0) or take the
motor down a ramp of 0x6085 under position control (2, and 6, which stays in QUICK_STOP_ACTIVE holding the position).
After the ramp the position is held for `BRAKE_DELAY_NS`, the time a holding brake needs to close, and only then the
power goes. A watched node that falls silent is answered as 0x6007 says: 0 nothing, 1 fault, 2 power off, 3 quick stop.
A drive that leaves NMT OPERATIONAL loses power, unless it is on such a ramp, which it finishes.
"""

import math
from typing import NamedTuple

from emulator.device import Device
from protocols import cia402, emcy, nmt
from protocols.cia402 import (
    SUPPORTED,
    TRANSITIONS,
    Event,
    Mode,
    State,
    Status,
    decode_controlword,
)
from protocols.dictionary import PER_MILLE, drive_dictionary
from protocols.frames import Frame
from protocols.objects import Entry, Value, key
from protocols.robot import Drive as DriveConfig
from protocols.sdo import Abort, SdoError

MODE_DELAY_NS = 2_000_000  # from 0x6060 to 0x6061: drives change mode in a background task of a few milliseconds
BRAKE_DELAY_NS = 50_000_000  # from standstill to power off; holding brakes of this size close in 30 to 80 ms
RAMP_STEP_NS = 1_000_000  # how often a stopping drive moves on where no SYNC comes

_CYCLES = key(0x2001)
_SYNC_TIMEOUT = key(0x2003)
_KR, _TN = key(0x2010), key(0x2011)
_ABORT_CONNECTION = key(0x6007)
_ERROR_CODE = key(0x603F)
_STATUSWORD = key(0x6041)
_QUICK_STOP = key(0x605A)
_FAULT_REACTION = key(0x605E)
_MODE, _MODE_DISPLAY = key(0x6060), key(0x6061)
_POSITION_INTERNAL, _POSITION = key(0x6063), key(0x6064)
_WINDOW, _WINDOW_TIME = key(0x6065), key(0x6066)
_VELOCITY = key(0x606C)
_TARGET_TORQUE, _MAX_TORQUE, _MAX_CURRENT, _DEMAND = key(0x6071), key(0x6072), key(0x6073), key(0x6074)
_TORQUE, _CURRENT = key(0x6077), key(0x6078)
_TARGET_POSITION, _DECELERATION = key(0x607A), key(0x6085)
_POSITION_OFFSET, _TORQUE_OFFSET = key(0x60B0), key(0x60B2)
_FOLLOWING_ERROR = key(0x60F4)

_WINDOW_OFF = 0xFFFF_FFFF  # value of 0x6065 that switches the supervision off
_COAST, _RAMP, _HOLD = 0, 2, 6  # values of 0x605A; 0x605E has the first two
_IGNORE, _FAULT, _STOP = 0, 1, 3  # values of 0x6007; 2, power off, is what remains

_LISTENING = (nmt.State.PRE_OPERATIONAL, nmt.State.OPERATIONAL)
_MOVING = (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE)
_POWERED = (State.READY_TO_SWITCH_ON, State.SWITCHED_ON, *_MOVING)

# Plain numbers for the code that runs with every SYNC: flags of the enum module cost a microsecond each.
_CSP, _CST = int(Mode.CSP), int(Mode.CST)
_LIMITED = int(Status.INTERNAL_LIMIT | Status.FOLLOWS_COMMAND)
_FOLLOWS, _FOLLOWING = int(Status.FOLLOWS_COMMAND), int(Status.FOLLOWING_ERROR)
_UNPOWERED = (State.NOT_READY_TO_SWITCH_ON, State.SWITCH_ON_DISABLED, State.FAULT)
_STATUS = {s: int(s.pattern | Status.REMOTE | (0 if s in _UNPOWERED else Status.VOLTAGE_ENABLED)) for s in State}


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


class _Ramp(NamedTuple):
    """Constant deceleration from the motion at its start."""

    start_ns: int
    position: float
    velocity: float
    deceleration: float

    def at(self, t_ns: int) -> float:
        """Position [counts]."""
        t = min(1e-9 * (t_ns - self.start_ns), abs(self.velocity) / self.deceleration)
        return self.position + self.velocity * t - math.copysign(self.deceleration, self.velocity) * t * t / 2

    @property
    def end_ns(self) -> int:
        return self.start_ns + round(1e9 * abs(self.velocity) / self.deceleration) + BRAKE_DELAY_NS


class Drive:
    """One axis' drive. Frames in, frames out; time is an argument.

    Attributes:
        state: Of the power drive system.
        device: The CANopen side.
    """

    _last_sync_ns: int | None
    _gains_changed: bool

    def __init__(self, config: DriveConfig, node_id: int) -> None:
        self.config = config
        self.device = Device(drive_dictionary(config), node_id, self)
        self._values = self.device.store.values
        self._per_mille = PER_MILLE / config.rated_current_A
        store = self.device.store
        store.guard(0x605A, lambda _, value: _one_of(value, (_COAST, _RAMP, _HOLD)))
        store.guard(0x605E, lambda _, value: _one_of(value, (_COAST, _RAMP)))
        store.guard(0x6040, self._control)
        store.guard(0x6060, self._check_mode, self._change_mode)
        store.guard(0x2010, consequence=self._mark_gains)
        store.guard(0x2011, consequence=self._mark_gains)
        self.reset()

    # --- what the rig calls ---

    def start(self, t_ns: int) -> list[Frame]:
        """Power on."""
        return self.device.start(t_ns)

    def receive(self, t_ns: int, frame: Frame) -> list[Frame]:
        """Handle one frame other than SYNC; returns the frames to send."""
        return self.device.receive(t_ns, frame)

    def tick(self, t_ns: int) -> list[Frame]:
        """Handle what is due by `t_ns`; returns the frames to send."""
        return self.device.tick(t_ns)

    def on_sync(self, t_ns: int, counter: int | None, measurement: Measurement) -> list[Frame]:
        """SYNC: latch the axis, let the targets received before it take effect, send TPDOs.

        Args:
            counter: Its data byte; None where it has none.
            measurement: Of this instant.
        """
        device, values = self.device, self._values
        device.timers.now_ns = t_ns
        if device.state in _LISTENING:
            values[_CYCLES] = (values[_CYCLES] + 1) & 0xFFFF
            self._last_sync_ns = t_ns
            self._supervise_sync()
        self.latch(measurement)
        if self.state is State.OPERATION_ENABLED and self._mode == _CSP:
            self._supervise_following(t_ns)
        return device.sync(t_ns, counter)

    def latch(self, measurement: Measurement) -> None:
        """Take over what the sensors read; `on_sync` does it by itself."""
        values = self._values
        position, velocity, current_A = measurement
        values[_POSITION] = values[_POSITION_INTERNAL] = ((position + 0x8000_0000) & 0xFFFF_FFFF) - 0x8000_0000
        values[_VELOCITY] = max(-0x8000_0000, min(0x7FFF_FFFF, velocity))
        values[_TORQUE] = values[_CURRENT] = max(-0x8000, min(0x7FFF, round(current_A * self._per_mille)))

    def command(self) -> Command:
        """What the power stage has to do from now on."""
        return self._command

    def current_gains(self) -> tuple[float, float]:
        """KR [V/A] and TN [s] of the current loop."""
        return self._values[_KR], 1e-3 * self._values[_TN]

    def changed_gains(self) -> tuple[float, float] | None:
        """As `current_gains`, once after every change and after power on; None in between."""
        if not self._gains_changed:
            return None
        self._gains_changed = False
        return self.current_gains()

    def fault(self, t_ns: int, code: int) -> list[Frame]:
        """A fault of the machine; returns the frames to send."""
        self.device.timers.now_ns = t_ns
        self._fail(code)
        return self.device.settle(t_ns)

    # --- emulator.device.Application ---

    def reset(self) -> None:
        self.state = TRANSITIONS[State.NOT_READY_TO_SWITCH_ON, Event.INITIALISED]  # the self-test takes no time
        self._controlword = 0
        self._mode = self._requested_mode = int(Mode.NONE)
        self._ramp: _Ramp | None = None
        self._release = False  # power goes when the ramp is over
        self._faults: set[int] = set()
        self._outside_since_ns: int | None = None  # following error beyond its window
        self._following_error = False
        self._limited = False
        self._last_sync_ns = None
        self._watching_sync = False
        self._gains_changed = True
        self.update()

    def nmt_changed(self, old: nmt.State, new: nmt.State) -> None:
        self._last_sync_ns = None  # supervision begins with the first SYNC of the new state
        if old is not nmt.State.OPERATIONAL or self.state is State.FAULT_REACTION_ACTIVE:
            return
        if self._ramp is not None and self.device.timers.now_ns < self._ramp.end_ns:
            self._release = True
        elif self.state in _POWERED:
            self._enter(State.SWITCH_ON_DISABLED)

    def connection_lost(self) -> None:
        reaction = self._values[_ABORT_CONNECTION]
        if self.state not in _POWERED or reaction == _IGNORE:
            return
        if reaction == _FAULT:
            self._fail(emcy.Code.HEARTBEAT_LOST)
        elif reaction == _STOP and self.state is State.OPERATION_ENABLED:
            self._enter(State.QUICK_STOP_ACTIVE)
        else:
            self._enter(State.SWITCH_ON_DISABLED)

    def update(self) -> None:
        self._command = self._demand()
        status = _STATUS[self.state]
        if self.state is State.OPERATION_ENABLED and self._mode:
            status |= _LIMITED if self._limited else _FOLLOWS
        self._values[_STATUSWORD] = status | _FOLLOWING if self._following_error else status

    # --- power drive system ---

    def _demand(self) -> Command:
        values = self._values
        values[_DEMAND] = 0
        if self._ramp is not None:
            return Command(_CSP, self._ramp.at(self.device.timers.now_ns), 0.0)
        if self.state is not State.OPERATION_ENABLED or not self._mode:
            return Command(0, values[_POSITION], 0.0)
        if self._mode == _CSP:
            return Command(_CSP, values[_TARGET_POSITION] + values[_POSITION_OFFSET], 0.0)
        target = values[_TARGET_TORQUE] + values[_TORQUE_OFFSET]
        limit = min(values[_MAX_TORQUE], values[_MAX_CURRENT], 0x7FFF)
        applied = max(-limit, min(limit, target))
        self._limited = applied != target
        values[_DEMAND] = applied
        return Command(_CST, values[_POSITION], applied / self._per_mille)

    def _enter(self, state: State) -> None:
        """Take a transition with what the option codes attach to it."""
        old, self.state = self.state, state
        self._limited = False
        moving = old in _MOVING
        if state is State.QUICK_STOP_ACTIVE:
            option = self._values[_QUICK_STOP]
            self._release = option != _HOLD
            if option == _COAST:
                self._enter(State.SWITCH_ON_DISABLED)  # transitions 11 and 12
            else:
                self._brake()
        elif state is State.FAULT_REACTION_ACTIVE:
            if moving and self._values[_FAULT_REACTION] == _RAMP:
                self._brake()
            else:
                self._enter(TRANSITIONS[state, Event.REACTION_DONE])
        else:
            self._ramp = None
            self._outside_since_ns = None
            self.device.timers.cancel("ramp")

    def _brake(self) -> None:
        """Begin a ramp, or go on with the one that runs."""
        if self._ramp is None:
            values = self._values
            start_ns = self.device.timers.now_ns
            self._ramp = _Ramp(start_ns, values[_POSITION], values[_VELOCITY], values[_DECELERATION])
        self._follow_ramp()

    def _follow_ramp(self) -> None:
        if self._ramp is None:
            return
        now_ns = self.device.timers.now_ns
        if now_ns < self._ramp.end_ns:
            self.device.timers.schedule("ramp", now_ns + RAMP_STEP_NS, self._follow_ramp)
        elif self.state is State.FAULT_REACTION_ACTIVE:
            self._enter(TRANSITIONS[self.state, Event.REACTION_DONE])
        elif self._release:
            self._enter(State.SWITCH_ON_DISABLED)  # transition 12

    def _control(self, _: Entry, value: Value) -> None:
        """A controlword has come."""
        word = int(value)
        command = decode_controlword(word, self._controlword)
        self._controlword = word
        if command is None:
            return
        target = TRANSITIONS.get((self.state, command))
        if target is None:
            return
        if self.state is State.QUICK_STOP_ACTIVE and target is State.OPERATION_ENABLED and self._release:
            return  # transition 16 is for option codes that hold
        if command is cia402.Command.FAULT_RESET and not self._forget_faults():
            return
        self._enter(target)

    def _check_mode(self, _: Entry, value: Value) -> None:
        _one_of(value, (Mode.NONE, *SUPPORTED))

    def _change_mode(self) -> None:
        requested = self._values[_MODE]
        if requested != self._requested_mode:
            self._requested_mode = requested
            self.device.timers.schedule("mode", self.device.timers.now_ns + MODE_DELAY_NS, self._show_mode)

    def _show_mode(self) -> None:
        self._mode = self._values[_MODE_DISPLAY] = self._requested_mode
        self._limited = False
        self._outside_since_ns = None

    def _mark_gains(self) -> None:
        self._gains_changed = True

    # --- faults ---

    def _fail(self, code: int) -> None:
        self._faults.add(code)
        self._values[_ERROR_CODE] = code
        self.device.emergencies.occur(code)
        reaction = TRANSITIONS.get((self.state, Event.FAULT))
        if reaction is not None:
            self._enter(reaction)

    def _forget_faults(self) -> bool:
        """Clear what has been reported; False where a cause is still there."""
        emergencies = self.device.emergencies
        silent = emcy.Code.HEARTBEAT_LOST
        if silent in self._faults and emergencies.is_active(silent):
            return False
        for code in sorted(self._faults):
            emergencies.vanish(code)
        self._faults.clear()
        self._following_error = False
        self._values[_ERROR_CODE] = 0
        return True

    def _supervise_following(self, now_ns: int) -> None:
        """Compare the position with the target it had to reach by now (0x6065, 0x6066)."""
        values = self._values
        error = round(self._command.target_position) - values[_POSITION]
        values[_FOLLOWING_ERROR] = max(-0x8000_0000, min(0x7FFF_FFFF, error))
        window = values[_WINDOW]
        if window == _WINDOW_OFF or abs(error) <= window:
            self._outside_since_ns = None
        elif self._outside_since_ns is None:
            self._outside_since_ns = now_ns
        elif now_ns - self._outside_since_ns >= values[_WINDOW_TIME] * 1_000_000:
            self._following_error = True
            self._fail(emcy.Code.FOLLOWING_ERROR)

    def _supervise_sync(self) -> None:
        """Watch for the SYNC after this one, while enabled and only there (0x2003)."""
        if not self._watching_sync and self.state is State.OPERATION_ENABLED:
            self._watching_sync = True
            self._check_sync()

    def _check_sync(self) -> None:
        timers, timeout_ns = self.device.timers, self._values[_SYNC_TIMEOUT] * 1_000_000
        self._watching_sync = False
        if not timeout_ns or self._last_sync_ns is None or self.state is not State.OPERATION_ENABLED:
            return
        if timers.now_ns >= self._last_sync_ns + timeout_ns:
            self._fail(emcy.Code.SYNC_LOST)
        else:
            self._watching_sync = True
            timers.schedule("sync", self._last_sync_ns + timeout_ns, self._check_sync)


def _one_of(value: Value, allowed: tuple[int, ...]) -> None:
    if value not in allowed:
        raise SdoError(Abort.VALUE)
