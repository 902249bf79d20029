"""A CANopen device (CiA 301) without an application: network management, SDO, PDO, EMCY, heartbeat.

Frames in, frames out; time is an argument. What the device is for, a CiA 402 drive for instance, is an `Application`.
"""

from collections.abc import Callable
from functools import partial
from typing import Protocol

from emulator.emergency import EmergencyProducer
from emulator.heartbeat import HeartbeatConsumer, HeartbeatProducer
from emulator.pdos import PdoEngine
from emulator.store import ObjectStore
from emulator.timers import Timers
from protocols import emcy, nmt
from protocols.dictionary import INVALID
from protocols.frames import Frame
from protocols.objects import Dictionary, Entry, Value, key
from protocols.sdo import Abort, SdoError, Server

SDO_TIMEOUT_NS = 1_000_000_000  # of a client in a segmented transfer; what CANopenNode allows by default
_PERIOD = key(0x1006)
_OVERFLOW = key(0x1019)
_ON_COMMUNICATION_ERROR = key(0x1029, 1)

_SDO_STATES = (nmt.State.PRE_OPERATIONAL, nmt.State.OPERATIONAL)  # also of SYNC and EMCY (CiA 301, table 37)


class Application(Protocol):
    """What a device is for. Calls come within `Device.receive`, `sync` and `tick`."""

    def reset(self) -> None:
        """NMT reset of the node: as after power on. The store's values are already restored."""

    def nmt_changed(self, old: nmt.State, new: nmt.State) -> None:
        """The NMT state has changed."""

    def connection_lost(self) -> None:
        """A node that this one watches has fallen silent; 0x1029 is obeyed after this call."""

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

    def update(self) -> None:
        pass


class Device:
    """One node.

    Attributes:
        state: NMT state.
        store: The dictionary's values.
        emergencies: Where the application reports errors.
        timers: The present instant and what is due later.
        ignored: Frames that no device may react to: remote, 29-bit, error and malformed ones, and those under an
            identifier that belongs to this node.
    """

    def __init__(self, dictionary: Dictionary, node_id: int, application: Application | None = None) -> None:
        self.node_id = node_id
        self.state = nmt.State.INITIALISING
        self.ignored = 0
        self._application: Application = application or Passive()
        self._out: list[Frame] = []
        self._routes: dict[int, Callable[[bytes], bool]] = {}
        self.timers = Timers()
        self.store = ObjectStore(dictionary, node_id)
        self.emergencies = EmergencyProducer(self.store, self.timers, self._send)
        self._heartbeat = HeartbeatProducer(self.store, self.timers, self._send_heartbeat)
        self._consumer = HeartbeatConsumer(self.store, self.timers, self._heartbeat_lost, self._heartbeat_found)
        self._sdo = Server(self.store)
        self._pdos = PdoEngine(self.store, self.timers, self.emergencies, self._send, self._route)
        self.store.guard(0x1005, self._check_sync_id)
        self.store.guard(0x1016, consequence=self._watch)
        self.store.guard(0x1017, consequence=self._heartbeat.start)
        self.store.guard(0x1019, self._check_overflow)

    # --- what the bus calls ---

    def start(self, t_ns: int) -> list[Frame]:
        """Power on: one boot-up message, then PRE_OPERATIONAL."""
        self.timers.now_ns = t_ns
        self._boot()
        return self._flush()

    def receive(self, t_ns: int, frame: Frame) -> list[Frame]:
        """Handle one frame. SYNC comes through `sync` instead.

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
        """SYNC: synchronous RPDOs take effect, synchronous TPDOs go out.

        Args:
            counter: Its data byte; None where it has none.
        """
        self.timers.now_ns = t_ns
        if t_ns >= self.timers.next_ns:
            self.timers.run()
        operational = self.state is nmt.State.OPERATIONAL
        if operational or self.state is nmt.State.PRE_OPERATIONAL:
            self._check_sync_length(counter)
        if operational:
            self._pdos.activate()
        self._application.update()
        if operational:
            self._pdos.transmit()
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

    # --- inside ---

    def _settle(self) -> None:
        self._application.update()
        self._pdos.check_events()

    def _send(self, frame: Frame) -> None:
        self._out.append(frame)

    def _flush(self) -> list[Frame]:
        if not self._out:
            return []
        out, self._out = self._out, []
        return out

    def _send_heartbeat(self) -> None:
        self._send(nmt.heartbeat(self.node_id, self.state))

    def _boot(self) -> None:
        """From INITIALISING to PRE_OPERATIONAL."""
        self._send(nmt.heartbeat(self.node_id, nmt.State.INITIALISING))
        self._heartbeat.start()
        self._consumer.configure()
        self._enter(nmt.State.PRE_OPERATIONAL)

    def _enter(self, state: nmt.State) -> None:
        old, self.state = self.state, state
        self.emergencies.enabled = state in _SDO_STATES
        if state not in _SDO_STATES:
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
        self._end_transfer()
        self._consumer.reset()
        self.store.restore(0x1000, 0x1FFF if communication_only else 0xFFFF)
        self.emergencies.reset(communication_only=communication_only)
        if communication_only:
            self._application.nmt_changed(old, self.state)
        else:
            self.timers.clear()
            self._application.reset()
        self._boot()

    def _route(self) -> None:
        """Which identifiers are heard: this is where the NMT state gates the services (CiA 301, table 37)."""
        self._routes = {
            nmt.NMT: self._on_nmt,
            nmt.heartbeat_id(self.node_id): self._on_own_identifier,
            nmt.sdo_response_id(self.node_id): self._on_own_identifier,
        }
        for node in self._consumer.watched:
            self._routes[nmt.heartbeat_id(node)] = partial(self._on_heartbeat, node)
        if self.state is nmt.State.OPERATIONAL:
            self._routes |= self._pdos.routes()
        if self.state in _SDO_STATES:
            self._routes[nmt.sdo_request_id(self.node_id)] = self._on_sdo

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

    def _on_heartbeat(self, node: int, data: bytes) -> bool:
        self._consumer.receive(node, data)
        return True

    def _on_sdo(self, data: bytes) -> bool:
        if len(data) != 8:
            self.ignored += 1
            return False
        self._respond(self._sdo.receive(data))
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

    def _watch(self) -> None:
        self._consumer.configure()
        self._route()

    def _heartbeat_lost(self, node: int) -> None:
        self.emergencies.occur(emcy.Code.HEARTBEAT_LOST, bytes((node,)))
        self._application.connection_lost()
        reaction = self.store.values[_ON_COMMUNICATION_ERROR]
        if reaction == 0 and self.state is nmt.State.OPERATIONAL:
            self._enter(nmt.State.PRE_OPERATIONAL)
        elif reaction == 2:
            self._enter(nmt.State.STOPPED)

    def _heartbeat_found(self, _: int) -> None:
        if self._consumer.all_found:
            self.emergencies.vanish(emcy.Code.HEARTBEAT_LOST)

    def _check_sync_length(self, counter: int | None) -> None:
        if counter is None and self.store.values[_OVERFLOW]:
            self.emergencies.occur(emcy.Code.SYNC_LENGTH)
        elif self.emergencies.is_active(emcy.Code.SYNC_LENGTH):
            self.emergencies.vanish(emcy.Code.SYNC_LENGTH)

    @staticmethod
    def _check_sync_id(_: Entry, value: Value) -> None:
        if int(value) & ~INVALID != nmt.SYNC:  # neither a producer nor on another identifier than the rig's clock
            raise SdoError(Abort.VALUE)

    def _check_overflow(self, _: Entry, value: Value) -> None:
        if value == 1:  # CiA 301, 7.5.2.22: 0, or 2 to 240
            raise SdoError(Abort.VALUE)
        if self.store.values[_PERIOD]:
            raise SdoError(Abort.STATE)
