"""Drives with something wrong: what stands between a rig and a drive while faults are scheduled for it."""

from collections.abc import Callable
from heapq import heappop, heappush
from random import Random

from emulator.axis import Command, Measurement
from emulator.device import Device
from emulator.drive import Drive
from emulator.faults import CODES, COMMANDS, NEVER_NS, Fault, Kind
from emulator.traces import TraceRecorder
from protocols import nmt
from protocols.frames import EXTENDED, REMOTE, Frame

FOREIGN_HEARTBEAT_NS = 100_000_000  # of a second device with the same node-id

Action = Callable[[int], list[Frame]]  # of the instant; returns frames that appear on the drive's bus


class ImpairedDrive:
    """A drive whose senses, voice and supply can be taken away. To its rig it is a drive like any other."""

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        self._suppressed: set[int] = set()
        self._offline = False
        self._unpowered = False
        self._syncless = False
        self._jump = 0
        self._frozen: int | None = None
        self._position = 0

    # --- what the rig calls, as of `Drive` ---

    @property
    def device(self) -> Device:
        return self._drive.device

    @property
    def recorder(self) -> TraceRecorder:
        return self._drive.recorder

    def start(self, t_ns: int) -> list[Frame]:
        return self._drive.start(t_ns)

    def receive(self, t_ns: int, frame: Frame) -> list[Frame]:
        if self._offline or self._unpowered:
            return []
        return self._heard(self._drive.receive(t_ns, frame))

    def tick(self, t_ns: int) -> list[Frame]:
        return [] if self._unpowered else self._heard(self._drive.tick(t_ns))

    def on_sync(self, t_ns: int, counter: int | None, measurement: Measurement) -> list[Frame]:
        if self._offline or self._syncless or self._unpowered:
            return self.proceed(t_ns, measurement)
        if self._jump and counter is not None:
            counter, self._jump = (counter + self._jump) & 0xFF, 0
        return self._heard(self._drive.on_sync(t_ns, counter, self._read(measurement)))

    def proceed(self, t_ns: int, measurement: Measurement) -> list[Frame]:
        return [] if self._unpowered else self._heard(self._drive.proceed(t_ns, self._read(measurement)))

    def command(self) -> Command:
        return self._drive.command()

    def changed_gains(self) -> tuple[float, float] | None:
        return self._drive.changed_gains()

    def changed_limit(self) -> float | None:
        return self._drive.changed_limit()

    def _heard(self, frames: list[Frame]) -> list[Frame]:
        """What of its words reaches the bus."""
        if self._offline:
            return []
        return [f for f in frames if f.can_id not in self._suppressed] if self._suppressed else frames

    def _read(self, measurement: Measurement) -> Measurement:
        if self._frozen is not None:
            return Measurement(self._frozen, 0, measurement.current_A)
        self._position = measurement.position
        return measurement

    # --- what goes wrong ---

    def begin(self, fault: Fault, t_ns: int) -> list[Frame]:
        """A fault sets in."""
        drive, node, kind = self._drive, self.device.node_id, fault.kind
        if kind in COMMANDS:
            return self._heard(drive.receive(t_ns, nmt.command(COMMANDS[kind], node)))
        if kind is Kind.HEARTBEAT_LOSS:
            self._suppressed.add(nmt.heartbeat_id(node))
        elif kind is Kind.SDO_SILENCE:
            self._suppressed.add(nmt.sdo_response_id(node))
        elif kind is Kind.SYNC_LOSS:
            self._syncless = True
        elif kind is Kind.SYNC_JUMP:
            self._jump = fault.by
        elif kind is Kind.OFFLINE:
            self._offline = True
            drive.device.lose_bus(t_ns)
        elif kind is Kind.POWER_LOSS:
            drive.start(t_ns)  # everything is off and forgotten; nobody hears it boot
            self._unpowered = True
        elif kind is Kind.DUPLICATE_NODE:
            return [nmt.heartbeat(node, nmt.State.INITIALISING)]
        elif kind is Kind.GARBAGE:
            return garbage(fault.count, fault.seed)
        if kind is Kind.ENCODER:
            self._frozen = self._position
        if kind is Kind.EMCY or kind in CODES:
            return self._heard(drive.fault(t_ns, fault.code))
        return []

    def end(self, fault: Fault, t_ns: int) -> list[Frame]:
        """A fault is over."""
        drive, node, kind = self._drive, self.device.node_id, fault.kind
        if kind is Kind.HEARTBEAT_LOSS:
            self._suppressed.discard(nmt.heartbeat_id(node))
        elif kind is Kind.SDO_SILENCE:
            self._suppressed.discard(nmt.sdo_response_id(node))
        elif kind is Kind.SYNC_LOSS:
            self._syncless = False
        elif kind is Kind.OFFLINE:
            self._offline = False
            return drive.device.find_bus(t_ns)
        elif kind is Kind.POWER_LOSS:
            self._unpowered = False
            return drive.start(t_ns)
        elif kind is Kind.ENCODER:
            self._frozen = None
        return []


class Schedule:
    """What goes wrong when.

    Attributes:
        next_ns: When `run` has something to do.
    """

    def __init__(self) -> None:
        self._due: list[tuple[int, int, ImpairedDrive, Action]] = []
        self._count = 0
        self.next_ns = NEVER_NS

    def add(self, fault: Fault, drive: ImpairedDrive) -> None:
        """Have a fault befall a drive."""
        self._at(fault.begin_ns, drive, lambda t_ns: drive.begin(fault, t_ns))
        if fault.end_ns < NEVER_NS:
            self._at(fault.end_ns, drive, lambda t_ns: drive.end(fault, t_ns))
        if fault.kind is Kind.DUPLICATE_NODE:
            self._repeat(fault, drive, fault.begin_ns)

    def run(self, t_ns: int) -> list[tuple[ImpairedDrive, list[Frame]]]:
        """Whatever is due; returns the frames that appear on the bus of a drive."""
        appeared = []
        while self.next_ns <= t_ns:
            _, _, drive, action = heappop(self._due)
            self.next_ns = self._due[0][0] if self._due else NEVER_NS
            appeared.append((drive, action(t_ns)))
        return appeared

    def _at(self, due_ns: int, drive: ImpairedDrive, action: Action) -> None:
        heappush(self._due, (due_ns, self._count, drive, action))  # the count keeps the order of equals
        self._count += 1
        self.next_ns = self._due[0][0]

    def _repeat(self, fault: Fault, drive: ImpairedDrive, last_ns: int) -> None:
        """Heartbeats of a foreign device."""
        due_ns = last_ns + FOREIGN_HEARTBEAT_NS

        def beat(_: int) -> list[Frame]:
            self._repeat(fault, drive, due_ns)
            return [nmt.heartbeat(drive.device.node_id, nmt.State.PRE_OPERATIONAL)]

        if due_ns < fault.end_ns:
            self._at(due_ns, drive, beat)


def garbage(count: int, seed: int) -> list[Frame]:
    """Random frames of every form: any identifier but SYNC's and NMT's, any length, remote and 29-bit ones."""
    random = Random(seed)
    frames = []
    for _ in range(count):
        flags = random.choice((0, 0, 0, REMOTE, EXTENDED))
        can_id = random.randrange(0x081, 0x2000_0000 if flags == EXTENDED else 0x800)
        size = random.randrange(9)
        data = b"" if flags == REMOTE else random.randbytes(size)
        frames.append(Frame(can_id | flags, data, size if flags == REMOTE else 0))
    return frames
