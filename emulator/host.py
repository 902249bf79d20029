"""The motion host: configures the drives, enables them, streams the PD law of the paper, stops safely.

Written as one script that reads like the procedure it is. Each `yield` is one SYNC period: it hands over the frames
to send and comes back with the frames that have arrived since. Whoever drives it decides what a period is: a
wait on a real bus, or one step of simulated time.
"""

import contextlib
import struct
from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocols import cia402, emcy, motion, nmt, pdo, sdo
from protocols.dictionary import drive_dictionary
from protocols.errors import ConfigError, PeerError
from protocols.frames import Frame
from protocols.objects import key
from protocols.rig import Rig
from protocols.robot import Robot

HOST_NODE = 127
HEARTBEAT_PERIODS = 25
HOST_LOST_MS = 500  # drives stop by themselves when the host has been silent for so long
ANSWER_PERIODS = 1000  # SDO timeout
ENABLE_PERIODS = 2000
BRAKING_S = 0.5  # from any speed to rest after a stop request
DRIVE_BEAT_MS = 100
DRIVE_LOST_S = 0.35  # three heartbeats missed, and a little more
QUICK_STOP_S = 0.3  # for the drives' own ramps, and their brakes

_POSITION, _TARGET_TORQUE, _TARGET_POSITION = key(0x6064), key(0x6071), key(0x607A)
_AIM = {cia402.Mode.CST: _TARGET_TORQUE, cia402.Mode.CSP: _TARGET_POSITION}
_INT16 = 32767

Box = list[list[Frame]]
Script = Generator[Box, Sequence[Sequence[Frame]], None]


class PdLaw:
    """Joint PD of Janot et al. 2014, eq. (19): v = (kp kv (qr - q) - kv dq) J / g, velocity by a two-tap difference.

    Where motors are coupled the law acts on joints and its torques are shared out to the drives.
    """

    def __init__(self, robot: Robot, period_s: float) -> None:
        stiffness, damping = [], []
        for joint in robot.joint:
            if joint.control is None:
                raise ConfigError(f"{robot.name}: {joint.name} has no [joint.control]; the host needs one to move it.")
            w, z, inertia = joint.control.natural_frequency_rad_s, joint.control.damping, joint.control.inertia_kgm2
            stiffness.append(w**2 * inertia)  # kp kv J
            damping.append(2 * z * w * inertia / period_s)  # kv J, on a difference of positions
        self._stiffness, self._damping = np.array(stiffness), np.array(damping)
        self._limit = np.array([j.torque_max_Nm for j in robot.joint])
        self._to_current = robot.drive_current(np.eye(robot.joints))
        self._last: NDArray[np.float64] | None = None

    def current(self, reference: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Drive currents for one period, shapes (J,) [A]."""
        step = np.zeros_like(q) if self._last is None else q - self._last
        self._last = q
        torque = self._stiffness * (reference - q) - self._damping * step
        return np.clip(torque, -self._limit, self._limit) @ self._to_current


def interpolation_period(period_s: float) -> tuple[int, int]:
    """Value and power of ten for 0x60C2, as exact as one byte allows."""
    index = next((i for i in range(-6, 0) if round(period_s * 10.0**-i) <= 0xFF), 0)
    value = round(period_s * 10.0**-index)
    while value % 10 == 0 and index < 0:
        value, index = value // 10, index + 1
    return value, index


@dataclass
class _Axis:
    """One drive as the host knows it."""

    joint: str
    node: int
    bus: int
    position: int = 0
    controlword: int = 0
    statusword: int = 0
    mode: int = 0
    transfer: sdo.Download | sdo.Upload | None = None
    error: emcy.Emergency | None = None
    heard: int = 0  # cycle of the last heartbeat
    booted: bool = False  # since the motion began

    @property
    def name(self) -> str:
        return f"{self.joint} (node {self.node})"


class Host:
    """Motion host of one rig.

    Args:
        plan: What to do once the arm is enabled.
        mode: 10, cyclic synchronous torque: the PD law runs here; 8, cyclic synchronous position: in the drives.
    """

    def __init__(self, rig: Rig, robot: Robot, plan: motion.Motion, mode: cia402.Mode = cia402.Mode.CST) -> None:
        bus_names = [b.name for b in rig.bus]
        place = {d.joint: d for d in rig.drive}
        self._robot, self._plan, self._mode = robot, plan, mode
        self._period_s = rig.sync_period_us * 1e-6
        self._overflow = rig.sync_overflow
        self._axes = [_Axis(j, place[j].node, bus_names.index(place[j].bus)) for j in robot.joint_names]
        self._buses = len(bus_names)
        self._layouts = rig.pdo.feedback, rig.pdo.target
        objects = drive_dictionary(robot.joint[0].drive)
        self._feedback = pdo.parse_layout(rig.pdo.feedback, objects, transmit=True)
        self._target = pdo.parse_layout(rig.pdo.target, objects, transmit=False)
        for index, layout, name in ((_POSITION, self._feedback, "feedback"), (_AIM[mode], self._target, "target")):
            if index not in layout.keys:
                raise ConfigError(
                    f"{rig.name}: pdo.{name} lacks {index >> 8:04X}:0, without which the arm cannot move."
                )
        self._position_slot = self._feedback.keys.index(_POSITION)
        eye = np.eye(robot.joints)  # both conversions are linear: as matrices they cost a product each cycle
        self._to_joint, self._to_counts = robot.joint_position(eye), robot.motor_counts(eye)
        self._per_mille = 1000 / np.array([j.drive.rated_current_A for j in robot.joint])
        self._law = PdLaw(robot, self._period_s) if mode == cia402.Mode.CST else None
        self._by_id = {
            (axis.bus, can_id): (handle, axis)
            for axis in self._axes
            for can_id, handle in (
                (nmt.tpdo_id(1, axis.node), self._on_feedback),
                (nmt.tpdo_id(2, axis.node), self._on_status),
                (nmt.sdo_response_id(axis.node), self._on_sdo),
                (nmt.emcy_id(axis.node), self._on_emcy),
                (nmt.heartbeat_id(axis.node), self._on_heartbeat),
            )
        }
        self._counter = 0
        self._beat = 0
        self._stopping = False
        self.expected_answers = 0  # feedback PDOs that the last burst asks for

    def stop(self) -> None:
        """Brake and finish instead of following the motion to its end."""
        self._stopping = True

    def answers_in(self, frames: Iterable[Frame]) -> int:
        """How many of `frames` are feedback of a SYNC."""
        return sum(0x180 < f.can_id <= 0x1FF for f in frames)

    def script(self) -> Script:
        """The whole procedure; ends when the arm stands and the drives are off.

        Raises:
            PeerError: A drive does not answer, refuses a setting, does not enable, or has a fault.
        """
        fault: PeerError | None = None
        try:
            yield from self._configure()
            path = yield from self._plan_path()
            yield from self._enable(path.q[0])
            yield from self._follow(path)
        except PeerError as error:  # whatever one drive does, none may stay powered
            fault = error
            yield from self._quick_stop()
        yield from self._disable()
        if fault is not None:
            raise fault

    # --- one period ---

    def _cycle(self, burst: Box, *, sync: bool = True) -> Generator[Box, Sequence[Sequence[Frame]], None]:
        """Send a burst with SYNC last and the host's heartbeat when due; take in what has come."""
        if self._beat % HEARTBEAT_PERIODS == 0:
            for frames in burst:
                frames.append(nmt.heartbeat(HOST_NODE, nmt.State.OPERATIONAL))
        self._beat += 1
        if sync:
            self._counter = nmt.next_counter(self._counter, self._overflow)
            for frames in burst:
                frames.append(nmt.sync(self._counter))
        self.expected_answers = len(self._axes) if sync else 0
        received = yield burst
        for bus, batch in enumerate(received):
            for frame in batch:
                found = self._by_id.get((bus, frame.can_id))
                if found is not None:
                    handle, axis = found
                    handle(axis, frame)

    def _box(self) -> Box:
        return [[] for _ in range(self._buses)]

    def _on_feedback(self, axis: _Axis, frame: Frame) -> None:
        if len(frame.data) == self._feedback.size:
            axis.position = int(self._feedback.unpack(frame.data)[self._position_slot])

    def _on_status(self, axis: _Axis, frame: Frame) -> None:
        if len(frame.data) == _STATUS.size:
            axis.statusword, axis.mode, _ = _STATUS.unpack(frame.data)

    def _on_sdo(self, axis: _Axis, frame: Frame) -> None:
        if axis.transfer is None or axis.transfer.done:
            return
        try:
            request = axis.transfer.receive(frame.data)
        except sdo.SdoError as abort:
            raise PeerError(f"{axis.name} refused a setting: {abort}") from abort
        if request is not None:
            self._requests[axis.bus].append(Frame(nmt.sdo_request_id(axis.node), request))

    def _on_emcy(self, axis: _Axis, frame: Frame) -> None:
        message = emcy.decode(frame.data)
        if message is not None and message.code not in emcy.WARNINGS:
            axis.error = message

    def _on_heartbeat(self, axis: _Axis, frame: Frame) -> None:
        axis.heard = self._beat
        axis.booted |= nmt.decode_heartbeat(frame.data) is nmt.State.INITIALISING

    # --- configuration ---

    def _configure(self) -> Script:
        yield from self._cycle(self._broadcast(nmt.Command.ENTER_PRE_OPERATIONAL), sync=False)
        for settings in zip(*(self._settings(axis.node) for axis in self._axes), strict=True):
            yield from self._write(settings)
        yield from self._cycle(self._broadcast(nmt.Command.START), sync=False)

    def _settings(self, node: int) -> list[tuple[int, int, bytes]]:
        """(index, sub, value) in the order that CiA 301, 7.5.2.36 asks for when a PDO is remapped."""
        feedback, target = ([pdo.Mapped.parse(t) for t in texts] for texts in self._layouts)
        value, index = interpolation_period(self._period_s)
        return [
            *pdo.configuration(pdo.TRANSMIT, 1, nmt.tpdo_id(1, node), feedback, 1),
            *pdo.configuration(pdo.RECEIVE, 2, nmt.rpdo_id(2, node), target, 1),
            (0x1019, 0, bytes([self._overflow])),
            (0x1016, 1, (HOST_NODE << 16 | HOST_LOST_MS).to_bytes(4, "little")),
            (0x1017, 0, DRIVE_BEAT_MS.to_bytes(2, "little")),
            *((0x60C2, sub, bytes([part & 0xFF])) for sub, part in ((1, value), (2, index))),
            (0x6060, 0, bytes([self._mode])),
        ]

    def _write(self, settings: Sequence[tuple[int, int, bytes]]) -> Script:
        """One object on every drive at once."""
        self._requests = self._box()
        for axis, (index, sub, value) in zip(self._axes, settings, strict=True):
            axis.transfer = sdo.Download(index, sub, value)
            self._requests[axis.bus].append(Frame(nmt.sdo_request_id(axis.node), axis.transfer.request()))
        for _ in range(ANSWER_PERIODS):
            burst, self._requests = self._requests, self._box()
            yield from self._cycle(burst, sync=False)
            waiting = [a for a in self._axes if a.transfer is not None and not a.transfer.done]
            if not waiting:
                return
        index, sub, _ = settings[0]
        raise PeerError(
            f"{', '.join(a.name for a in waiting)} did not answer SDO {index:04X}:{sub:02X} within"
            f" {ANSWER_PERIODS * self._period_s:.1f} s. Is the rig running on these buses?"
        )

    def _broadcast(self, command: nmt.Command) -> Box:
        return [[nmt.command(command)] for _ in range(self._buses)]

    # --- motion ---

    def _measured(self) -> NDArray[np.float64]:
        return np.array([a.position for a in self._axes]) @ self._to_joint

    def _aim(self, reference: NDArray[np.float64]) -> Box:
        """Target PDOs of every drive that hold or follow a reference, shape (J,) [rad]."""
        burst = self._box()
        counts = np.rint(reference @ self._to_counts).astype(int).tolist()
        torque = [0] * len(self._axes)
        if self._law is not None:
            current = self._law.current(reference, self._measured()) * self._per_mille
            torque = np.rint(np.clip(current, -_INT16, _INT16)).astype(int).tolist()
        values = dict.fromkeys(self._target.keys, 0)  # what else the layout carries stays zero
        for axis, target, target_torque in zip(self._axes, counts, torque, strict=True):
            values[_TARGET_POSITION], values[_TARGET_TORQUE] = target, target_torque
            burst[axis.bus].append(Frame(nmt.rpdo_id(2, axis.node), self._target.pack(values)))
        return burst

    def _plan_path(self) -> Generator[Box, Sequence[Sequence[Frame]], motion.Reference]:
        """Reference from where the arm stands, made while the brakes hold it: enabled drives wait for no one."""
        for _ in range(3):  # the first SYNCs bring the first positions
            yield from self._cycle(self._box())
        return motion.sample(self._plan, self._robot, self._period_s, self._measured())

    def _enable(self, hold: NDArray[np.float64]) -> Script:
        for _ in range(ENABLE_PERIODS):
            burst = self._aim(hold)
            for axis in self._axes:
                state = cia402.state_of(axis.statusword) or cia402.State.NOT_READY_TO_SWITCH_ON
                axis.controlword = cia402.controlword_to_enable(state, axis.controlword)
                burst[axis.bus].insert(0, self._control(axis))
            yield from self._cycle(burst)
            waiting = [a for a in self._axes if not self._is_enabled(a)]
            if not waiting:
                return
        raise PeerError(
            f"{', '.join(a.name for a in waiting)} did not reach OPERATION ENABLED within"
            f" {ENABLE_PERIODS * self._period_s:.1f} s (statusword {waiting[0].statusword:04X}h)."
        )

    def _is_enabled(self, axis: _Axis) -> bool:
        return cia402.state_of(axis.statusword) is cia402.State.OPERATION_ENABLED and axis.mode == self._mode

    def _follow(self, path: motion.Reference) -> Script:
        for axis in self._axes:
            axis.booted, axis.heard = False, self._beat
        for k, reference in enumerate(path.q):
            if self._stopping:
                yield from self._brake(reference, path.qd[k])
                return
            yield from self._cycle(self._aim(reference))
            for axis in self._axes:
                trouble = self._trouble(axis)
                if trouble:
                    raise PeerError(
                        f"{axis.name}: {trouble} after {k * self._period_s:.3f} s of motion; all drives are being"
                        " switched off."
                    )

    def _trouble(self, axis: _Axis) -> str:
        """What is wrong with a drive that should be following; empty if nothing."""
        if axis.booted:
            return "the drive has been reset"
        if axis.error is not None and axis.error.code:
            return f"the drive reports error {axis.error.code:04X}h"
        if not self._is_enabled(axis):
            return f"the drive has left OPERATION ENABLED (statusword {axis.statusword:04X}h)"
        silent_s = (self._beat - axis.heard) * self._period_s
        return f"no heartbeat for {silent_s:.2f} s" if silent_s > DRIVE_LOST_S else ""

    def _quick_stop(self) -> Script:
        """Have every drive that can brake on its own."""
        for _ in range(round(QUICK_STOP_S / self._period_s)):
            yield from self._command(cia402.Command.QUICK_STOP)

    def _command(self, command: cia402.Command) -> Script:
        burst = self._box()
        for axis in self._axes:
            axis.controlword = cia402.CONTROLWORD[command]
            burst[axis.bus].append(self._control(axis))
        yield from self._cycle(burst)

    def _brake(self, q: NDArray[np.float64], qd: NDArray[np.float64]) -> Script:
        steps = round(BRAKING_S / self._period_s)
        for k in range(steps):
            s = k / steps  # speed falls linearly to zero
            yield from self._cycle(self._aim(q + qd * BRAKING_S * (s - s**2 / 2)))

    def _disable(self) -> Script:
        for command in (cia402.Command.SHUTDOWN, cia402.Command.DISABLE_VOLTAGE):
            for _ in range(10):
                yield from self._command(command)
        yield from self._cycle(self._broadcast(nmt.Command.ENTER_PRE_OPERATIONAL), sync=False)
        with contextlib.suppress(PeerError):  # a drive that no longer answers is off, or told already
            yield from self._write([(0x1016, 1, bytes(4))] * len(self._axes))  # nobody is to miss us

    def _control(self, axis: _Axis) -> Frame:
        return Frame(nmt.rpdo_id(1, axis.node), _CONTROL.pack(axis.controlword, self._mode))


_STATUS = struct.Struct("<HbH")  # TPDO2: 6041, 6061, 603F
_CONTROL = struct.Struct("<Hb")  # RPDO1: 6040, 6060
