"""Frames to cycles and events: a pure function of what was on the buses, live and in replay."""

from collections.abc import Callable, Iterable
from functools import partial

from daq.cycles import Assembler, Cycle, DriveLine
from daq.feedback import Reader, reader
from daq.integrity import Integrity
from protocols import emcy, errorframes, nmt
from protocols.frames import ERROR, Frame
from protocols.rig import DriveNode, Rig
from protocols.robot import Robot
from protocols.topics import ERROR_LEVEL, INFO, WARNING, Event

_LEVELS: dict[errorframes.State | None, int] = {errorframes.State.BUS_OFF: ERROR_LEVEL, errorframes.State.ACTIVE: INFO}
_COMMANDS = {
    nmt.Command.START: "start",
    nmt.Command.STOP: "stop",
    nmt.Command.ENTER_PRE_OPERATIONAL: "enter pre-operational",
    nmt.Command.RESET_NODE: "reset node",
    nmt.Command.RESET_COMMUNICATION: "reset communication",
}
_EMERGENCIES = {  # CiA 301, table 26, first byte
    0x10: "generic error",
    0x20: "current",
    0x21: "current on the input side",
    0x22: "current inside the device",
    0x23: "current on the output side",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside the device",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "device temperature",
    0x43: "drive temperature",
    0x50: "device hardware",
    0x60: "device software",
    0x70: "additional modules",
    0x73: "sensor",
    0x80: "monitoring",
    0x81: "communication monitoring",
    0x82: "protocol error",
    0x86: "position controller",
    0x87: "synchronisation",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "manufacturer specific",
}


class Decoder:
    """Listens to all buses of a rig.

    Attributes:
        integrity: Counters; the decoder counts frames, the assembler SYNCs and TPDO1s.
    """

    def __init__(self, rig: Rig, robot: Robot, integrity: Integrity) -> None:
        self.integrity = integrity
        self._events: list[Event] = []
        buses = {d.joint: d.bus for d in rig.drive}
        self._assembler = Assembler(
            [(name, buses[name]) for name in robot.joint_names],
            rig.sync_period_us * 1000,
            rig.sync_overflow,
            integrity,
        )
        self._states: dict[tuple[str, int], nmt.State] = {}
        self._off_since_ns: dict[str, int] = {}
        self._drives: dict[tuple[str, int], DriveLine] = {}
        self._handlers: dict[str, dict[int, Callable[[int, bytes], None]]] = {}
        nodes = {d.joint: d for d in rig.drive}
        read = reader(rig.pdo.feedback)
        for bus in rig.bus:
            table = self._handlers[bus.name] = {
                nmt.SYNC: partial(self._sync, bus.name),
                nmt.NMT: partial(self._command, bus.name),
            }
            for line in self._assembler.drives:
                node = nodes[line.joint]
                if node.bus == bus.name:
                    self._drives[bus.name, node.node] = line
                    table[nmt.tpdo_id(1, node.node)] = partial(self._feedback, line, read)
                    table[nmt.emcy_id(node.node)] = partial(self._emergency, node)
                    table[nmt.heartbeat_id(node.node)] = partial(self._heartbeat, node)

    def feed(self, bus: str, batch: Iterable[tuple[int, Frame]]) -> None:
        """Frames of one bus, in order: pairs (arrival in ns since the run started, frame)."""
        handlers = self._handlers[bus]
        count = 0
        for t_ns, frame in batch:
            count += 1
            handler = handlers.get(frame.can_id)
            if handler is not None:
                handler(t_ns, frame.data)
            elif frame.can_id & ERROR:
                self._bus_error(t_ns, bus, frame)
        self.integrity.bus[bus].frames += count

    def finish(self, *, cut_off: bool = False) -> None:
        """The run is over, or its recording was cut off; what is left can be taken."""
        self._assembler.finish(cut_off=cut_off)

    def take_cycles(self) -> list[Cycle]:
        """Finished cycles since the last call, in order."""
        cycles, self._assembler.ready = self._assembler.ready, []
        return cycles

    def take_events(self) -> list[Event]:
        """Events since the last call."""
        notes, self._assembler.notes = self._assembler.notes, []
        events = self._events + [Event(t_ns, INFO, source, text) for t_ns, source, text in notes]
        self._events = []
        return events

    # --- handlers ---

    def _sync(self, bus: str, t_ns: int, data: bytes) -> None:
        if len(data) > 1:
            self.integrity.bus[bus].malformed += 1
        else:
            self._assembler.sync(t_ns, bus, data[0] if data else None)

    def _feedback(self, line: DriveLine, read: Reader, t_ns: int, data: bytes) -> None:
        if len(data) != read.size:
            line.sync.counters.malformed += 1
        elif read.counted:
            self._assembler.feedback(t_ns, line, *read.values(data))
        else:
            position, current, _ = read.values(data)
            self._assembler.uncounted_feedback(t_ns, line, position, current)

    def _command(self, bus: str, t_ns: int, data: bytes) -> None:
        command = nmt.decode_command(data)
        if command is None:
            return
        what, node = command
        who = f"node {node}" if node else "all nodes"
        self._events.append(Event(t_ns, INFO, bus, f"NMT: {_COMMANDS[what]}, {who}"))
        if what != nmt.Command.START:
            for (on, number), line in self._drives.items():
                if on == bus and node in (0, number):
                    line.excused = True

    def _heartbeat(self, node: DriveNode, t_ns: int, data: bytes) -> None:
        state = nmt.decode_heartbeat(data)
        if state is None:
            return
        if state != nmt.State.OPERATIONAL:
            self._drives[node.bus, node.node].excused = True
        before = self._states.get((node.bus, node.node))
        if state == nmt.State.INITIALISING:
            level = INFO if before is None else WARNING
            self._events.append(Event(t_ns, level, node.joint, f"boot-up of node {node.node} on {node.bus}"))
        elif state != before:
            name = state.name.lower().replace("_", "-")
            self._events.append(Event(t_ns, INFO, node.joint, f"node {node.node} on {node.bus} is {name}"))
        self._states[node.bus, node.node] = state

    def _emergency(self, node: DriveNode, t_ns: int, data: bytes) -> None:
        content = emcy.decode(data)
        if content is None:
            self.integrity.bus[node.bus].malformed += 1
        elif content.code == emcy.Code.NONE:
            self._events.append(Event(t_ns, INFO, node.joint, f"node {node.node} on {node.bus}: no error any more"))
        else:
            group = _EMERGENCIES.get(content.code >> 8, _EMERGENCIES.get(content.code >> 8 & 0xF0, "unknown class"))
            text = (
                f"node {node.node} on {node.bus}: emergency 0x{content.code:04X}, {group}"
                f" (error register 0x{content.register:02X})"
            )
            self._events.append(Event(t_ns, ERROR_LEVEL, node.joint, text))

    def _bus_error(self, t_ns: int, bus: str, frame: Frame) -> None:
        report = errorframes.decode(frame)
        text = f"error frame: {report.text}"
        if report.state is errorframes.State.BUS_OFF:
            self._off_since_ns.setdefault(bus, t_ns)
        elif report.classes & errorframes.Class.RESTARTED and bus in self._off_since_ns:
            text += f" after {(t_ns - self._off_since_ns.pop(bus)) * 1e-9:.3f} s off the bus"
        self._events.append(Event(t_ns, _LEVELS.get(report.state, WARNING), bus, text))
