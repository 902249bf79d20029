"""A CANopen device (CiA 301) without an application: network management, SDO, PDO, EMCY, heartbeat, guarding, LSS.

Frames in, frames out; time is an argument. What the device is for, a CiA 402 drive for instance, is an `Application`.
"""

from collections.abc import Callable
from functools import partial
from typing import Protocol

from emulator.emergency import EmergencyProducer
from emulator.guarding import NodeGuard
from emulator.heartbeat import HeartbeatConsumer, HeartbeatProducer
from emulator.lssserver import LssServer
from emulator.pdos import PdoEngine
from emulator.store import ObjectStore
from emulator.synchronisation import Synchronisation, TimeOfDay
from emulator.timers import Timers
from protocols import emcy, lss, nmt
from protocols.frames import REMOTE, Frame
from protocols.objects import Dictionary, key
from protocols.sdoblock import BlockServer

SDO_TIMEOUT_NS = 1_000_000_000  # of a client in a segmented transfer; what CANopenNode allows by default
BIT_RATE = 1_000_000  # [bit/s]
_ON_COMMUNICATION_ERROR = key(0x1029, 1)
_IDENTITY = tuple(key(0x1018, i) for i in (1, 2, 3, 4))

_SDO_STATES = (nmt.State.PRE_OPERATIONAL, nmt.State.OPERATIONAL)  # also of SYNC and EMCY (CiA 301, table 37)


class Application(Protocol):
    """What a device is for. Calls come within `Device.receive`, `sync` and `tick`."""

    def reset(self) -> None:
        """NMT reset of the node: as after power on. The store's values are already restored."""

    def nmt_changed(self, old: nmt.State, new: nmt.State) -> None:
        """The NMT state has changed."""

    def connection_lost(self) -> None:
        """A node that this one depends on has fallen silent; 0x1029 is obeyed after this call."""

    def synchronised(self) -> None:
        """SYNC has come, in a state that listens to it; RPDOs take effect after this call."""

    def cycle(self) -> None:
        """The rig's next period begins, with the targets that count for it."""

    def update(self) -> None:
        """Something may have changed: bring values up to date before TPDOs go out."""


class Passive:
    """The application of a device that only communicates."""

    def reset(self) -> None:
        pass

    def nmt_changed(self, old: nmt.State, new: nmt.State) -> None:
        pass

    def connection_lost(self) -> None:
        pass

    def synchronised(self) -> None:
        pass

    def cycle(self) -> None:
        pass

    def update(self) -> None:
        pass


class Device:
    """One node.

    Attributes:
        node_id: 255 while it has none.
        state: NMT state.
        store: The dictionary's values.
        emergencies: Where the application reports errors.
        timers: The present instant and what is due later.
        hears_sync: The rig's SYNC, at its usual identifier, reaches this device.
        ignored: Frames that no device may react to: remote, 29-bit, error and malformed ones, and those under an
            identifier that belongs to this node.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        node_id: int,
        application: Application | None = None,
        *,
        serial: int | None = None,
        bit_rate: int = BIT_RATE,
    ) -> None:
        """
        Args:
            serial: Serial number; the first node-id where left out.
            bit_rate: Of the bus; the device begins with the same [bit/s].
        """
        self.node_id = node_id
        self.state = nmt.State.INITIALISING
        self.ignored = 0
        self.hears_sync = False
        self._application: Application = application or Passive()
        self._bus_rate = bit_rate
        self._out: list[Frame] = []
        self._routes: dict[int, Callable[[bytes], bool]] = {}
        self.timers = Timers()
        self.store = ObjectStore(dictionary, node_id)
        self.store.make_default(0x1018, 4, node_id if serial is None else serial)
        self.emergencies = EmergencyProducer(self.store, self.timers, self._send)
        self._heartbeat = HeartbeatProducer(self.store, self.timers, self._send_heartbeat)
        self._consumer = HeartbeatConsumer(self.store, self.timers, self._heartbeat_lost, self._all_found)
        self._guard = NodeGuard(self.store, self.timers, self._answer_guard, self._master_lost, self._all_found)
        self._sdo = BlockServer(self.store)
        self._pdos = PdoEngine(self.store, self.timers, self.emergencies, self._send, self._route)
        self._sync = Synchronisation(self.store, self.timers, self.emergencies, self._send, self._route)
        self._time = TimeOfDay(self.store, self.timers, self._route)
        identity = lss.Identity(*(self.store.values[k] for k in _IDENTITY))
        self._lss = LssServer(identity, node_id, bit_rate, self.timers, self._send, self._configured, self._route)
        self.store.guard(0x1016, consequence=self._watch)
        self.store.guard(0x1017, consequence=self._heartbeat.start)

    # --- what the bus calls ---

    def start(self, t_ns: int) -> list[Frame]:
        """Power on: one boot-up message, then PRE_OPERATIONAL. A device without node-id waits for LSS instead."""
        self.timers.now_ns = t_ns
        self._lss.power_on()
        self._reset(communication_only=False)
        return self._flush()

    def hears(self, can_id: int) -> bool:
        """Whether a frame with this identifier and flags would be handled."""
        return can_id in self._routes

    def receive(self, t_ns: int, frame: Frame) -> list[Frame]:
        """Handle one frame. SYNC comes through `sync` instead, unless 0x1005 has moved it.

        Returns:
            Frames to send.
        """
        handler = self._routes.get(frame.can_id)
        if handler is None:
            if frame.can_id > 0x7FF:  # a flag is set: remote, error or 29-bit frame
                self.ignored += 1
            return []
        self.timers.now_ns = t_ns
        if handler(frame.data):
            self._settle()
        return self._flush()

    def sync(self, t_ns: int, counter: int | None) -> list[Frame]:
        """SYNC of the rig: synchronous RPDOs take effect, the application goes on, synchronous TPDOs go out.

        Args:
            counter: Its data byte; None where it has none.
        """
        self.timers.now_ns = t_ns
        if self.hears_sync:
            self._synchronise(counter, self._application.cycle)
        else:
            self._application.cycle()
        if t_ns >= self.timers.next_ns:
            self.timers.run()
            self._application.update()
        self._pdos.check_events()
        return self._flush()

    def tick(self, t_ns: int) -> list[Frame]:
        """Handle what is due by `t_ns`."""
        if t_ns < self.timers.next_ns:
            return []
        self.timers.now_ns = t_ns
        self.timers.run()
        self._settle()
        return self._flush()

    def settle(self, t_ns: int) -> list[Frame]:
        """Send what follows from a change that came from the application's own world."""
        self.timers.now_ns = t_ns
        self._settle()
        return self._flush()

    def lose_bus(self, t_ns: int) -> None:
        """The controller has gone bus-off: a communication error, of which nothing can be said yet."""
        self.timers.now_ns = t_ns
        self._fail_communication()
        self._application.update()
        self._out.clear()

    def find_bus(self, t_ns: int) -> list[Frame]:
        """The controller is back on the bus."""
        self.timers.now_ns = t_ns
        self.emergencies.occur(emcy.Code.BUS_OFF_RECOVERED)
        self.emergencies.vanish(emcy.Code.BUS_OFF_RECOVERED)
        return self._flush()

    # --- inside ---

    def _settle(self) -> None:
        self._application.update()
        self._pdos.check_events()

    def _synchronise(self, counter: int | None, proceed: Callable[[], None]) -> None:
        operational = self.state is nmt.State.OPERATIONAL
        if operational or self.state is nmt.State.PRE_OPERATIONAL:
            self._sync.consume(counter)
            self._application.synchronised()
        if operational:
            self._pdos.activate(self.timers.now_ns)
        proceed()
        if operational:
            self._pdos.transmit(counter)

    def _send(self, frame: Frame) -> None:
        self._out.append(frame)

    def _flush(self) -> list[Frame]:
        if not self._out:
            return []
        out, self._out = self._out, []
        return [] if self._muted else out

    @property
    def _muted(self) -> bool:
        """Not on this bus: its bit rate is another, or is being changed."""
        return self._lss.quiet or self._lss.bit_rate != self._bus_rate

    def _send_heartbeat(self) -> None:
        self._send(nmt.heartbeat(self.node_id, self.state))

    def _boot(self) -> None:
        """From INITIALISING to PRE_OPERATIONAL, with the node-id that LSS has set."""
        self.node_id = self._lss.node_id
        if self.node_id == lss.UNCONFIGURED:
            self._route()
            return
        self._send(nmt.heartbeat(self.node_id, nmt.State.INITIALISING))
        self._heartbeat.start()
        self._consumer.configure()
        self._enter(nmt.State.PRE_OPERATIONAL)

    def _configured(self) -> None:
        """LSS is done with a device that had no node-id."""
        if self.node_id == lss.UNCONFIGURED != self._lss.node_id:
            self._reset(communication_only=True)

    def _enter(self, state: nmt.State) -> None:
        old, self.state = self.state, state
        self.emergencies.enabled = state in _SDO_STATES
        if state in _SDO_STATES:
            self._sync.start()
        else:
            self._sync.stop()
            self._end_transfer()
        if state is nmt.State.OPERATIONAL and old is not nmt.State.OPERATIONAL:
            self._pdos.start()
        elif state is not nmt.State.OPERATIONAL:
            self._pdos.stop()
        self._route()
        if state is not old:
            self._application.nmt_changed(old, state)

    def _reset(self, *, communication_only: bool) -> None:
        old, self.state = self.state, nmt.State.INITIALISING
        self._pdos.stop()
        self._sync.stop()
        self._end_transfer()
        self._consumer.reset()
        self._guard.reset()
        if self._lss.node_id not in {self.node_id, lss.UNCONFIGURED}:
            self.store.rebase(self._lss.node_id)
        self.store.restore(0x1000, 0x1FFF if communication_only else 0xFFFF)
        self.emergencies.reset(communication_only=communication_only)
        self.emergencies.enabled = False
        if communication_only:
            self._application.nmt_changed(old, self.state)
        else:
            self.timers.clear()
            self._application.reset()
        self._boot()

    def _route(self) -> None:
        """Which identifiers are heard: this is where the NMT state gates the services (CiA 301, table 37)."""
        self._routes = {}
        self.hears_sync = False
        if self._muted:
            return
        if self.node_id == lss.UNCONFIGURED:
            self._routes = {lss.REQUEST: self._on_lss}
            return
        self._routes = {
            nmt.NMT: self._on_nmt,
            nmt.heartbeat_id(self.node_id): self._on_own_identifier,
            nmt.heartbeat_id(self.node_id) | REMOTE: self._on_guard,
            nmt.sdo_response_id(self.node_id): self._on_own_identifier,
            lss.REQUEST: self._on_lss,
        }
        for node in self._consumer.watched:
            self._routes[nmt.heartbeat_id(node)] = partial(self._on_heartbeat, node)
        if self.state is nmt.State.OPERATIONAL:
            self._routes |= self._pdos.routes()
        if self.state in _SDO_STATES:
            self._routes[nmt.sdo_request_id(self.node_id)] = self._on_sdo
            if self._time.can_id is not None:
                self._routes[self._time.can_id] = self._on_time
            if self._sync.can_id != nmt.SYNC:
                self._routes[self._sync.can_id] = self._on_moved_sync
        self.hears_sync = self._sync.can_id == nmt.SYNC

    # --- frames ---

    def _on_nmt(self, data: bytes) -> bool:
        decoded = nmt.decode_command(data)
        if decoded is None:
            self.ignored += 1
            return False
        command, node = decoded
        if node not in {0, self.node_id}:
            return False
        if command in {nmt.Command.RESET_NODE, nmt.Command.RESET_COMMUNICATION}:
            self._reset(communication_only=command is nmt.Command.RESET_COMMUNICATION)
        else:
            self._enter(nmt.TRANSITIONS[command])
        return True

    def _on_own_identifier(self, _: bytes) -> bool:
        self.ignored += 1  # another node has this one's id
        return False

    def _on_guard(self, _: bytes) -> bool:
        self._guard.asked()
        return True

    def _on_heartbeat(self, node: int, data: bytes) -> bool:
        self._consumer.receive(node, data)
        return True

    def _on_lss(self, data: bytes) -> bool:
        self._lss.receive(data)
        return True

    def _on_time(self, data: bytes) -> bool:
        self._time.receive(data)
        return False

    def _on_moved_sync(self, data: bytes) -> bool:
        self._synchronise(data[0] if data else None, self._application.update)
        return False

    def _on_sdo(self, data: bytes) -> bool:
        if len(data) != 8:
            self.ignored += 1
            return False
        answers = self._sdo.receive(data)
        for answer in answers:
            self._respond(answer)
        if self._sdo.busy:
            self.timers.schedule("sdo", self.timers.now_ns + SDO_TIMEOUT_NS, lambda: self._respond(self._sdo.expire()))
        else:
            self.timers.cancel("sdo")
        return True

    def _respond(self, data: bytes | None) -> None:
        if data is not None:
            self._send(Frame(nmt.sdo_response_id(self.node_id), data))

    def _end_transfer(self) -> None:
        self._sdo.reset()
        self.timers.cancel("sdo")

    # --- who watches whom ---

    def _watch(self) -> None:
        self._consumer.configure()
        self._route()

    def _answer_guard(self, toggle: int) -> None:
        self._send(nmt.guard_response(self.node_id, self.state, toggle))

    def _heartbeat_lost(self, node: int) -> None:
        self.emergencies.occur(emcy.Code.HEARTBEAT_LOST, bytes((node,)))
        self._fail_communication()

    def _master_lost(self) -> None:
        self.emergencies.occur(emcy.Code.HEARTBEAT_LOST)
        self._fail_communication()

    def _fail_communication(self) -> None:
        self._application.connection_lost()
        reaction = self.store.values[_ON_COMMUNICATION_ERROR]
        if reaction == 0 and self.state is nmt.State.OPERATIONAL:
            self._enter(nmt.State.PRE_OPERATIONAL)
        elif reaction == 2:
            self._enter(nmt.State.STOPPED)

    def _all_found(self) -> None:
        if self._consumer.all_found and self._guard.satisfied:
            self.emergencies.vanish(emcy.Code.HEARTBEAT_LOST)
