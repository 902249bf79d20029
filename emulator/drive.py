"""CiA 402 servo drive of one axis: the device on the bus, between the master's targets and the arm's current loop.

How it stops. Quick stop (0x605A), shutdown (0x605B), disabling (0x605C) and the reaction to a fault (0x605E) either
cut the power at once (0) or take the motor to rest first (`stops`). A watched node that falls silent is answered
as 0x6007 says: 0 nothing, 1 fault, 2 power off, 3 quick stop. A drive that leaves NMT OPERATIONAL loses power, unless
it is stopping, which it finishes.
"""

from collections.abc import Sequence
from functools import partial

from emulator import cyclic, profiled
from emulator.axis import FOLLOW, LIMITS, MAX_CURRENT, MAX_TORQUE, Axis, Command, Measurement, clamp32
from emulator.device import BIT_RATE, Device
from emulator.homing import METHODS
from emulator.modes import Mode
from emulator.probe import TouchProbe
from emulator.stops import DISABLE, FAULT_REACTION, OPTIONS, QUICK_STOP, SHUTDOWN, Stop, at_rest, check_option
from emulator.traces import TraceRecorder
from protocols import cia402, emcy, nmt
from protocols.cia402 import SUPPORTED, TRANSITIONS, Event, State, Status, decode_controlword
from protocols.dictionary import drive_dictionary
from protocols.frames import Frame
from protocols.objects import Entry, Value, key
from protocols.robot import Drive as DriveConfig
from protocols.sdo import Abort, SdoError

MODE_DELAY_NS = 2_000_000  # from 0x6060 to 0x6061: drives change mode in a background task of a few milliseconds
PERIOD_NS = 1_000_000
GRID_S = 1e-4  # of the recorder's samples

MODES: tuple[type[Mode], ...] = (
    profiled.ProfilePosition,
    profiled.ProfileVelocity,
    profiled.ProfileTorque,
    profiled.Homing,
    cyclic.InterpolatedPosition,
    cyclic.CyclicPosition,
    cyclic.CyclicVelocity,
    cyclic.CyclicTorque,
)

_CYCLES = key(0x2001)
_SYNC_TIMEOUT = key(0x2003)
_KR, _TN = key(0x2010), key(0x2011)
_ABORT_CONNECTION = key(0x6007)
_ERROR_CODE = key(0x603F)
_STATUSWORD = key(0x6041)
_MODE, _MODE_DISPLAY = key(0x6060), key(0x6061)
_POSITION = key(0x6064)
_WINDOW, _WINDOW_TIME = key(0x6065), key(0x6066)
_DEMAND = key(0x6074)
_FOLLOWING_ERROR = key(0x60F4)

_WINDOW_OFF = 0xFFFF_FFFF  # value of 0x6065 that switches the supervision off
_IGNORE, _FAULT, _STOP = 0, 1, 3  # values of 0x6007; 2, power off, is what remains

_MOVING = (State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE)
_POWERED = (State.READY_TO_SWITCH_ON, State.SWITCHED_ON, *_MOVING)
_RAMPED = {State.READY_TO_SWITCH_ON: SHUTDOWN, State.SWITCHED_ON: DISABLE}  # transitions 8 and 5

_ENABLED = State.OPERATION_ENABLED
_FOLLOWING = int(Status.FOLLOWING_ERROR)  # plain numbers: flags of the enum module cost a microsecond each
_UNPOWERED = (State.NOT_READY_TO_SWITCH_ON, State.SWITCH_ON_DISABLED, State.FAULT)
_STATUS = {s: int(s.pattern | Status.REMOTE | (0 if s in _UNPOWERED else Status.VOLTAGE_ENABLED)) for s in State}


class Drive:
    """One axis' drive. Frames in, frames out; time is an argument, and the axis moves on once per rig period.

    Attributes:
        state: Of the power drive system.
        device: The CANopen side.
        axis: The side of the arm.
        recorder: What `record` fills.
    """

    _last_sync_ns: int | None
    _gains_changed: bool
    _limit_changed: bool

    def __init__(
        self,
        config: DriveConfig,
        node_id: int,
        *,
        period_ns: int = PERIOD_NS,
        travel: tuple[int, int] | None = None,
        grid_s: float = GRID_S,
        bit_rate: int = BIT_RATE,
        serial: int | None = None,
    ) -> None:
        """
        Args:
            node_id: 255: none yet, LSS will give one.
            period_ns: How often the rig calls `on_sync` or `proceed`.
            travel: Encoder counts of the limit switches.
            grid_s: Spacing of what `record` is given.
            bit_rate: Of the bus.
            serial: Serial number; the node-id where left out.
        """
        self.config = config
        self.device = Device(drive_dictionary(config), node_id, self, serial=serial, bit_rate=bit_rate)
        self._values = self.device.store.values
        store = self.device.store
        self.axis = Axis(config, self._values, self.device.timers, 1e-9 * period_ns, travel)
        self._modes = {mode.code: mode(self.axis) for mode in MODES}
        self._probe = TouchProbe(self.axis)
        self.recorder = TraceRecorder(store, self.axis, grid_s)
        for index in OPTIONS:
            store.guard(index, lambda entry, value: check_option(entry.index, value))
        store.guard(0x6040, self._control)
        store.guard(0x6060, partial(_one_of, (0, *SUPPORTED)), self._change_mode)
        store.guard(0x6098, partial(_one_of, METHODS))
        store.guard(0x60B8, consequence=self._probe.configure)
        for index in (0x2010, 0x2011):
            store.guard(index, consequence=partial(setattr, self, "_gains_changed", True))
        for index in LIMITS:
            store.guard(index, consequence=self._change_limits)
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
        self.device.timers.now_ns = t_ns
        self.axis.latch(measurement)
        return self.device.sync(t_ns, counter)

    def proceed(self, t_ns: int, measurement: Measurement) -> list[Frame]:
        """A period of the rig without SYNC: the axis is read and moves on all the same."""
        self.device.timers.now_ns = t_ns
        self.axis.latch(measurement)
        self.cycle()
        return self.device.settle(t_ns)

    def record(self, counts: Sequence[int], current_A: Sequence[float]) -> None:
        """What the axis did in the last period, on the recorder's grid."""
        self.recorder.feed(counts, current_A, enabled=self.state is State.OPERATION_ENABLED)

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

    def changed_limit(self) -> float | None:
        """Largest current [A] by 0x6072 and 0x6073, as `changed_gains`."""
        if not self._limit_changed:
            return None
        self._limit_changed = False
        limit: float = min(self._values[MAX_TORQUE], self._values[MAX_CURRENT]) / self.axis.per_mille
        return min(limit, self.config.max_current_A)

    def fault(self, t_ns: int, code: int) -> list[Frame]:
        """A fault of the machine; returns the frames to send."""
        self.device.timers.now_ns = t_ns
        self._fail(code)
        return self.device.settle(t_ns)

    # --- emulator.device.Application ---

    def reset(self) -> None:
        self.state = TRANSITIONS[State.NOT_READY_TO_SWITCH_ON, Event.INITIALISED]  # the self-test takes no time
        self._controlword = 0
        self._mode: Mode | None = None
        self._requested_mode = 0
        self._stop: Stop | None = None
        self._faults: set[int] = set()
        self._outside_since_ns: int | None = None  # following error beyond its window
        self._following_error = False
        self._last_sync_ns = None
        self._watching_sync = False
        self._gains_changed = self._limit_changed = True
        self.axis.reset()
        self._probe.reset()
        self.recorder.reset()
        self.update()
        self._change_mode()  # 0x1010 may have stored one

    def nmt_changed(self, old: nmt.State, new: nmt.State) -> None:
        self._last_sync_ns = None  # supervision begins with the first SYNC of the new state
        if old is not nmt.State.OPERATIONAL or self.state is State.FAULT_REACTION_ACTIVE:
            return
        if self._stop is not None and not self._stop.over:
            self._stop.then = self._stop.then or State.SWITCH_ON_DISABLED
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

    def synchronised(self) -> None:
        values = self._values
        values[_CYCLES] = (values[_CYCLES] + 1) & 0xFFFF
        self._last_sync_ns = self.device.timers.now_ns
        if not self._watching_sync and self.state is _ENABLED:
            self._watching_sync = True
            self._check_sync()

    def cycle(self) -> None:
        if self._probe.active:
            self._probe.step()
        if self._stop is not None:
            self._stop.step()
            if self._stop.over and self._stop.then is not None:
                self._enter(self._stop.then)
        elif self.state is _ENABLED and self._mode is not None:
            if self._mode.supervised and self.axis.following:
                self._supervise_following()
            self._mode.step()
        self.update()

    def update(self) -> None:
        state, mode = self.state, self._mode
        status = _STATUS[state]
        if self._stop is not None:
            self._command = self.axis.follow()
        elif mode is not None and state is _ENABLED:
            self._command = mode.demand()
            status |= mode.status()
        else:
            self._command = self.axis.off()
            self._values[_DEMAND] = 0
        self.axis.following = self._command.mode == FOLLOW
        self._values[_STATUSWORD] = status | _FOLLOWING if self._following_error else status

    # --- power drive system ---

    def _enter(self, state: State) -> None:
        """Take a transition with what the option codes attach to it."""
        old, self.state = self.state, state
        if state is State.QUICK_STOP_ACTIVE:
            option = self._values[QUICK_STOP]
            if option:
                self._stop = Stop(self.axis, option, State.SWITCH_ON_DISABLED)
            else:
                self._enter(State.SWITCH_ON_DISABLED)  # transitions 11 and 12
        elif state is State.FAULT_REACTION_ACTIVE:
            option = self._values[FAULT_REACTION]
            done = TRANSITIONS[state, Event.REACTION_DONE]
            if option and old in _MOVING:
                self._stop = Stop(self.axis, option, done)
            else:
                self._enter(done)
        else:
            self._stop = None
            self._outside_since_ns = None
            if state is State.OPERATION_ENABLED:
                self._begin()

    def _begin(self) -> None:
        """The mode takes the axis over."""
        if self._mode is not None:
            self._mode.start()
            self._mode.control(self._controlword, self._controlword)

    def _control(self, _: Entry, value: Value) -> None:
        """A controlword has come."""
        word, before = int(value), self._controlword
        self._controlword = word
        command = decode_controlword(word, before)
        target = None if command is None else TRANSITIONS.get((self.state, command))
        if target is not None and self._allows(command, target):
            self._enter(target)
        elif self.state is State.OPERATION_ENABLED and self._mode is not None and self._stop is None:
            self._mode.control(word, before)

    def _allows(self, command: cia402.Command | None, target: State) -> bool:
        """Whether a transition happens at once; a ramp may have to come first."""
        if self.state is State.QUICK_STOP_ACTIVE and target is State.OPERATION_ENABLED:
            return self._stop is None or self._stop.then is None  # transition 16 is for option codes that hold
        if command is cia402.Command.FAULT_RESET:
            return self._forget_faults()
        if self.state is State.OPERATION_ENABLED and target in _RAMPED and self._command.mode:
            option = self._values[_RAMPED[target]]
            if self._stop is None and option and not at_rest(self.axis, option):
                self._stop = Stop(self.axis, option, target)
            return self._stop is None
        return True

    def _change_limits(self) -> None:
        self.axis.take_limits()
        self._limit_changed = True

    def _change_mode(self) -> None:
        requested = self._values[_MODE]
        if requested != self._requested_mode:
            self._requested_mode = requested
            self.device.timers.schedule("mode", self.device.timers.now_ns + MODE_DELAY_NS, self._show_mode)

    def _show_mode(self) -> None:
        self._values[_MODE_DISPLAY] = self._requested_mode
        self._mode = self._modes.get(cia402.Mode(self._requested_mode))
        self._outside_since_ns = None
        if self.state is State.OPERATION_ENABLED and self._stop is None:
            self._begin()

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

    def _supervise_following(self) -> None:
        """Compare the position with the reference it had to reach by now (0x6065, 0x6066)."""
        values, now_ns = self._values, self.device.timers.now_ns
        error = clamp32(self.axis.reference.position - self.axis.user_position)
        values[_FOLLOWING_ERROR] = error
        window = values[_WINDOW]
        if window == _WINDOW_OFF or abs(error) <= window:
            self._outside_since_ns = None
        elif self._outside_since_ns is None:
            self._outside_since_ns = now_ns
        elif now_ns - self._outside_since_ns >= values[_WINDOW_TIME] * 1_000_000:
            self._following_error = True
            self._fail(emcy.Code.FOLLOWING_ERROR)

    def _check_sync(self) -> None:
        """Watch for the SYNC after this one, while enabled and only there (0x2003)."""
        timers, timeout_ns = self.device.timers, self._values[_SYNC_TIMEOUT] * 1_000_000
        self._watching_sync = False
        if not timeout_ns or self._last_sync_ns is None or self.state is not State.OPERATION_ENABLED:
            return
        if timers.now_ns >= self._last_sync_ns + timeout_ns:
            self._fail(emcy.Code.SYNC_LOST)
        else:
            self._watching_sync = True
            timers.schedule("sync", self._last_sync_ns + timeout_ns, self._check_sync)


def _one_of(allowed: tuple[int, ...], _: Entry, value: Value) -> None:
    if value not in allowed:
        raise SdoError(Abort.VALUE)
