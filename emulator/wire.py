"""A classical CAN bus in time: who transmits when, what everyone hears, what errors do (ISO 11898-1).

Frames have their true length with stuffing; of the controllers that want to send when the bus falls idle, the lowest
identifier wins. A controller sends in the order it was given, as Linux's queue does. Time is an argument.

Simplifications: an error is seen by everybody, so error flags take 6 + 6 bits; propagation takes no time, and an idle
bus may be taken at any instant, not only on a bit boundary.
"""

from collections import deque
from collections.abc import Hashable, Iterable
from random import Random
from typing import NamedTuple

from emulator.confinement import Confinement
from emulator.disturbance import NEVER_NS, Disturbance, Kind
from protocols.errorframes import Class, State, Status, encode
from protocols.frames import INTERMISSION_BITS, Frame, bit_length, priority

QUEUE_FRAMES = 1000  # of a vcan with the queue length that its users set; real interfaces have 10
_EARLIEST_ERROR_BIT = 14  # of a frame: once arbitration is over
_AFTER_ACK_BITS = 1 + 7 + INTERMISSION_BITS  # ACK delimiter, end of frame
_ERROR_BITS = 6 + 6 + 8 + INTERMISSION_BITS  # flag, its echo, delimiter
_SUSPEND_BITS = 8  # an error passive controller waits after its own frame


class Heard(NamedTuple):
    """Something that a controller's host gets to know.

    Attributes:
        t_ns: When: end of the frame.
        frame: What.
        senders: Stations that sent it, and do not hear it.
        to: The one station that hears it; None: every other that is on the bus.
    """

    t_ns: int
    frame: Frame
    senders: tuple[Hashable, ...]
    to: Hashable | None = None


class Traffic(NamedTuple):
    """What a bus has carried so far.

    Attributes:
        frames: That went through.
        errors: Attempts that met an error.
        lost: Given up: queue full, or sender off the bus.
        dropped: That nobody heard, by a disturbance.
        busy_ns: Time taken, intermission included.
    """

    frames: int = 0
    errors: int = 0
    lost: int = 0
    dropped: int = 0
    busy_ns: int = 0

    def load_since(self, earlier: "Traffic", elapsed_ns: int) -> float:
        """Share of the bus in between; 1.0 is a full bus."""
        return (self.busy_ns - earlier.busy_ns) / elapsed_ns


class _Controller:
    """A station's controller.

    Attributes:
        queue: Frames to send, with the time from which on and their rank in arbitration.
        ready_ns: When the first of them may start; `NEVER_NS` without.
        suspended_ns: Until when an error passive controller gives way.
        repeats: Whether the first frame has gone through already, unnoticed.
    """

    def __init__(self, station: Hashable, number: int) -> None:
        self.station = station
        self.queue: deque[tuple[int, int, Frame]] = deque()
        self.ready_ns = NEVER_NS
        self.suspended_ns = 0
        self.repeats = False
        self.restart_ns = NEVER_NS
        self.confinement = Confinement(number)

    def look(self) -> None:
        """The head of the queue has changed."""
        self.ready_ns = max(self.queue[0][0], self.suspended_ns) if self.queue else NEVER_NS

    @property
    def off(self) -> bool:
        return self.confinement.state is State.BUS_OFF


class _Transmission(NamedTuple):
    end_ns: int
    senders: list[_Controller]
    frame: Frame
    error: Class | None


class Wire:
    """One bus.

    Args:
        bitrate: [bit/s]; None: frames take no time, and disturbances are all there is.
        restart_ns: After which a controller that is off the bus comes back; `NEVER_NS` leaves it to `restart`.
        disturbances: See `emulator.disturbance`; those of other buses must not be among them.
        queue_frames: Longest queue of a controller.
        seed: Of the bit that errors strike.
    """

    def __init__(
        self,
        bitrate: int | None,
        restart_ns: int = 100_000_000,
        disturbances: Iterable[Disturbance] = (),
        queue_frames: int = QUEUE_FRAMES,
        seed: int = 1,
    ) -> None:
        self._bitrate = bitrate
        self._restart_ns = restart_ns
        self._queue_frames = queue_frames
        self._random = Random(seed)
        self._controllers: dict[Hashable, _Controller] = {}
        self._on_wire: _Transmission | None = None
        self._free_ns = 0
        self._alone = False  # the one controller here waits, error passive, for somebody to acknowledge
        self._troubled = False  # some counter is not 0
        self._timer_ns = NEVER_NS  # earliest restart or bus-off to come
        self._taking_off: list[Disturbance] = []
        self._holding_up: list[Disturbance] = []
        self._striking: dict[Kind, list[Disturbance]] = {}
        self._frames = self._errors = self._lost = self._dropped = self._busy_ns = 0
        for disturbance in disturbances:
            self.disturb(disturbance)

    # --- who is there ---

    def join(self, t_ns: int, station: Hashable, number: int = 0) -> None:
        """A controller goes on the bus.

        Args:
            t_ns: Now; not before the last call's.
            number: For its error frames, where several stand behind one interface.
        """
        self._controllers[station] = _Controller(station, number)
        self._resume(t_ns)

    def leave(self, station: Hashable) -> None:
        """A controller is taken off; what it had queued is gone."""
        del self._controllers[station]

    def hears(self, station: Hashable) -> bool:
        """Whether a station is on the bus at present."""
        return not self._controllers[station].off

    def state(self, station: Hashable) -> Confinement:
        """Error counters and state of a station."""
        return self._controllers[station].confinement

    def disturb(self, disturbance: Disturbance) -> None:
        """From now on this goes wrong, too."""
        if disturbance.kind is Kind.BUS_OFF:
            self._taking_off.append(disturbance)
            self._set_timer()
        elif disturbance.kind in {Kind.DELAY, Kind.JITTER}:
            self._holding_up.append(disturbance)
        else:
            self._striking.setdefault(disturbance.kind, []).append(disturbance)

    @property
    def traffic(self) -> Traffic:
        """Totals so far; a frame counts when it has ended."""
        return Traffic(self._frames, self._errors, self._lost, self._dropped, self._busy_ns)

    # --- frames in, frames out ---

    def offer(self, t_ns: int, station: Hashable, frame: Frame) -> Heard | None:
        """A host hands a frame to its controller.

        Args:
            t_ns: Now; not before the last call's.

        Returns:
            What the host is told when the queue is full; the frame is lost then.
        """
        controller = self._controllers[station]
        queue = controller.queue
        if controller.off:
            self._lost += 1
            return None
        if len(queue) >= self._queue_frames:
            self._lost += 1
            full = encode(Class.CONTROLLER, Status.TX_OVERFLOW, station=controller.confinement.number)
            return Heard(t_ns, full, (), station)
        ready_ns = t_ns
        for disturbance in self._holding_up:
            if disturbance.strikes(t_ns, frame.can_id):
                ready_ns += disturbance.lateness_ns()
        queue.append((ready_ns, priority(frame.can_id), frame))
        if len(queue) == 1:
            controller.look()
        return None

    @property
    def next_ns(self) -> int:
        """When something happens next; `NEVER_NS` while the bus is idle."""
        due_ns = self._on_wire.end_ns if self._on_wire is not None else self._next_start_ns()
        return due_ns if due_ns < self._timer_ns else self._timer_ns

    def advance(self, t_ns: int) -> list[Heard]:
        """All that hosts get to know by `t_ns`, in order."""
        heard: list[Heard] = []
        while (due_ns := self.next_ns) <= t_ns:
            if due_ns == self._timer_ns:
                self._run_timer(due_ns, heard)
            elif self._on_wire is None:
                self._begin(due_ns)
            else:
                self._end(self._on_wire, heard)
        return heard

    # --- inside ---

    def _ns(self, bits: int) -> int:
        return 0 if self._bitrate is None else bits * 1_000_000_000 // self._bitrate

    def _next_start_ns(self) -> int:
        if self._alone:
            return NEVER_NS
        ready_ns = min([c.ready_ns for c in self._controllers.values()], default=NEVER_NS)
        return ready_ns if ready_ns > self._free_ns else self._free_ns

    def _begin(self, t_ns: int) -> None:
        """Arbitration, and the fate of what wins it."""
        rank, senders = NEVER_NS, []
        for controller in self._controllers.values():
            if controller.ready_ns <= t_ns:
                own = controller.queue[0][1]
                if own < rank:
                    rank, senders = own, [controller]
                elif own == rank:
                    senders.append(controller)
        frame = senders[0].queue[0][2]
        bits = bit_length(frame)
        error = self._fate(t_ns, senders, frame)
        if error is not None:
            end = bits - _AFTER_ACK_BITS
            if error is not Class.NO_ACK:
                end = self._random.randint(_EARLIEST_ERROR_BIT, end)
            bits = end + _ERROR_BITS
        self._free_ns = t_ns + self._ns(bits)
        self._busy_ns += self._free_ns - t_ns
        self._on_wire = _Transmission(t_ns + self._ns(bits - INTERMISSION_BITS), senders, frame, error)

    def _fate(self, t_ns: int, senders: list[_Controller], frame: Frame) -> Class | None:
        if len(senders) > 1 and any(c.queue[0][2] != frame for c in senders):
            return Class.PROTOCOL  # two stations under one identifier: their bits differ sooner or later
        for disturbance in self._striking.get(Kind.CORRUPT, ()):
            if disturbance.strikes(t_ns, frame.can_id):
                return Class.PROTOCOL
        if all(c is senders[0] or c.off for c in self._controllers.values()):
            return Class.NO_ACK
        return None

    def _end(self, sent: _Transmission, heard: list[Heard]) -> None:
        self._on_wire = None
        if sent.error is not None:
            self._end_in_error(sent, heard)
            return
        self._frames += 1
        if self._troubled:
            self._count_success(sent, heard)
        repeated = not sent.senders[0].repeats and self._strikes(Kind.DUPLICATE, sent)
        for controller in sent.senders:
            controller.repeats = repeated
            if controller.queue and not repeated:  # not one that was taken off meanwhile
                controller.queue.popleft()
                controller.look()
        if self._strikes(Kind.DROP, sent):
            self._dropped += 1
        else:
            heard.append(Heard(sent.end_ns, sent.frame, tuple([c.station for c in sent.senders])))

    def _strikes(self, kind: Kind, sent: _Transmission) -> bool:
        return any([d.strikes(sent.end_ns, sent.frame.can_id) for d in self._striking.get(kind, ())])

    def _end_in_error(self, sent: _Transmission, heard: list[Heard]) -> None:
        self._errors += 1
        self._troubled = True
        unacknowledged = sent.error is Class.NO_ACK
        for controller in sent.senders:
            first = unacknowledged and not controller.confinement.tec
            if first:
                heard.append(self._tell(sent.end_ns, controller, encode(Class.NO_ACK)))
            self._note(sent, controller, controller.confinement.failed_to_send(unacknowledged=unacknowledged), heard)
            if controller.confinement.state is State.PASSIVE:
                self._suspend(controller)
                self._alone |= unacknowledged
        for controller in self._controllers.values():
            if controller not in sent.senders and not controller.off:
                self._note(sent, controller, controller.confinement.failed_to_receive(), heard)

    def _count_success(self, sent: _Transmission, heard: list[Heard]) -> None:
        self._troubled = False
        for controller in self._controllers.values():
            confinement = controller.confinement
            if controller.off:
                continue
            if controller in sent.senders:
                self._note(sent, controller, confinement.sent(), heard)
                if confinement.state is State.PASSIVE:
                    self._suspend(controller)
            else:
                self._note(sent, controller, confinement.received(), heard)
            self._troubled |= bool(confinement.tec or confinement.rec)

    def _suspend(self, controller: _Controller) -> None:
        controller.suspended_ns = self._free_ns + self._ns(_SUSPEND_BITS)
        controller.look()

    def _note(self, sent: _Transmission, controller: _Controller, report: Frame | None, heard: list[Heard]) -> None:
        """Pass on what a controller reports, and take it off the bus if that is what it says."""
        if report is None:
            return
        heard.append(self._tell(sent.end_ns, controller, report))
        if controller.off:
            self._take_off(sent.end_ns, controller, self._restart_ns)

    def _tell(self, t_ns: int, controller: _Controller, report: Frame) -> Heard:
        return Heard(t_ns, report, (), controller.station)

    def _take_off(self, t_ns: int, controller: _Controller, restart_ns: int) -> None:
        self._lost += len(controller.queue)
        controller.queue.clear()
        controller.look()
        controller.restart_ns = min(t_ns + restart_ns, NEVER_NS)
        self._set_timer()

    def _run_timer(self, t_ns: int, heard: list[Heard]) -> None:
        for controller in self._controllers.values():
            if controller.restart_ns <= t_ns:
                controller.restart_ns = NEVER_NS
                heard.append(self._tell(t_ns, controller, controller.confinement.restart()))
                self._resume(t_ns)
        for disturbance in [d for d in self._taking_off if d.begin_ns <= t_ns]:
            self._taking_off.remove(disturbance)
            for controller in self._controllers.values():
                confinement = controller.confinement
                if disturbance.node in {None, confinement.number} and not controller.off:
                    heard.append(self._tell(t_ns, controller, confinement.bus_off()))
                    self._take_off(t_ns, controller, disturbance.restart_ns)
        self._set_timer()

    def _resume(self, t_ns: int) -> None:
        """Somebody is there to acknowledge: who had waited for that tries again, from now on."""
        if self._alone:
            self._alone = False
            self._free_ns = max(self._free_ns, t_ns)

    def _set_timer(self) -> None:
        restarts = [c.restart_ns for c in self._controllers.values()]
        self._timer_ns = min([*restarts, *(d.begin_ns for d in self._taking_off)], default=NEVER_NS)
