"""LSS of a device (CiA 305): finding it by its serial number, giving it a node-id and a bit rate."""

from collections.abc import Callable

from emulator.timers import Timers
from protocols import lss, nmt
from protocols.frames import Frame
from protocols.lss import Identity, Mode, Service

_OUT_OF_RANGE = 1  # error code of node-id and bit timing
_TABLE = 0  # the one table of bit rates that CiA 305 defines
_MS = 1_000_000


class LssServer:
    """The device's side.

    Attributes:
        node_id: Pending; taken over when communication is reset.
        stored_node_id, stored_bit_rate: After power on.
        bit_rate: The device's own [bit/s]; it hears nothing on a bus with another.
        quiet: Between the two delays of a change of bit rate: neither sends nor hears.
    """

    def __init__(
        self,
        identity: Identity,
        node_id: int,
        bit_rate: int,
        timers: Timers,
        send: Callable[[Frame], None],
        configured: Callable[[], None],
        silenced: Callable[[], None],
    ) -> None:
        """
        Args:
            configured: Called when a device without node-id may start with `node_id`.
            silenced: Called when `bit_rate` or `quiet` has changed.
        """
        self._identity = identity
        self.node_id = self.stored_node_id = node_id
        self.bit_rate = self._pending_rate = self.stored_bit_rate = bit_rate
        self.quiet = False
        self._timers = timers
        self._send = send
        self._configured = configured
        self._silenced = silenced
        self._mode = Mode.WAITING
        self._selected = 0  # parts of the address that have matched
        self._matching: dict[Service, bool] = {}
        self._scanned = 0  # part that the fast scan is about

    def power_on(self) -> None:
        self.node_id = self.stored_node_id
        self.bit_rate = self._pending_rate = self.stored_bit_rate
        self.quiet = False
        self._timers.cancel("bit rate")
        self._timers.cancel("bit rate used")
        self._mode = Mode.WAITING
        self._selected = self._scanned = 0

    def receive(self, data: bytes) -> None:
        """Message of the master."""
        if len(data) != 8:
            return
        what, a, b = data[0], data[1], data[2]
        if Service.SWITCH_VENDOR <= what <= Service.SWITCH_SERIAL:
            self._select(what - Service.SWITCH_VENDOR, lss.value_of(data))
        elif Service.IDENTIFY_VENDOR <= what <= Service.IDENTIFY_SERIAL_HIGH:
            self._identify(Service(what), lss.value_of(data))
        elif what == Service.IDENTIFY_UNCONFIGURED:
            if self.node_id == lss.UNCONFIGURED:
                self._send(lss.message(Service.UNCONFIGURED_IDENTIFIED, response=True))
        elif what == Service.FASTSCAN:
            self._scan(lss.Scan.decode(data))
        elif what == Service.SWITCH_GLOBAL:
            self._switch(a)
        elif self._mode is Mode.CONFIGURATION:
            self._configure(what, a, b)

    def _switch(self, mode: int) -> None:
        if mode not in {Mode.WAITING, Mode.CONFIGURATION}:
            return
        was, self._mode = self._mode, Mode(mode)
        self._selected = 0
        if was is Mode.CONFIGURATION and self._mode is Mode.WAITING:
            self._configured()

    def _select(self, part: int, value: int) -> None:
        if part != self._selected or value != self._identity[part]:
            self._selected = 0
            if part != 0 or value != self._identity[0]:
                return
        self._selected += 1
        if self._selected == len(self._identity):
            self._selected = 0
            self._mode = Mode.CONFIGURATION
            self._send(lss.message(Service.SWITCHED, response=True))

    def _identify(self, what: Service, value: int) -> None:
        vendor, product, revision, serial = self._identity
        self._matching[what] = {
            Service.IDENTIFY_VENDOR: vendor == value,
            Service.IDENTIFY_PRODUCT: product == value,
            Service.IDENTIFY_REVISION_LOW: revision >= value,
            Service.IDENTIFY_REVISION_HIGH: revision <= value,
            Service.IDENTIFY_SERIAL_LOW: serial >= value,
            Service.IDENTIFY_SERIAL_HIGH: serial <= value,
        }[what]
        if what is Service.IDENTIFY_SERIAL_HIGH:
            if len(self._matching) == 6 and all(self._matching.values()):
                self._send(lss.message(Service.IDENTIFIED, response=True))
            self._matching.clear()

    def _scan(self, scan: lss.Scan) -> None:
        """Fast scan (CiA 305, 3.9.5): only devices without a node-id, in waiting, take part."""
        if self.node_id != lss.UNCONFIGURED or self._mode is not Mode.WAITING:
            return
        identified = lss.message(Service.IDENTIFIED, response=True)
        if scan.bit == lss.ANY:
            self._scanned = 0
            self._send(identified)
            return
        if scan.bit > 31 or scan.sub > 3 or scan.next_sub > 3 or scan.sub != self._scanned:
            return
        if (self._identity[scan.sub] ^ scan.number) >> scan.bit:
            return
        self._scanned = scan.next_sub
        self._send(identified)
        if scan.bit == 0 and scan.sub == 3 and scan.next_sub < scan.sub:
            self._mode = Mode.CONFIGURATION

    def _configure(self, what: int, a: int, b: int) -> None:
        """Services of the configuration state."""
        if what == Service.NODE_ID:
            valid = 1 <= a <= nmt.MAX_NODE or a == lss.UNCONFIGURED
            self.node_id = a if valid else self.node_id
            self._answer(Service.NODE_ID, 0 if valid else _OUT_OF_RANGE)
        elif what == Service.BIT_TIMING:
            rate = lss.BIT_RATES[b] if a == _TABLE and b < len(lss.BIT_RATES) else None
            self._pending_rate = rate or self._pending_rate
            self._answer(Service.BIT_TIMING, 0 if rate else _OUT_OF_RANGE)
        elif what == Service.ACTIVATE_BIT_TIMING:
            self._activate((a | b << 8) * _MS)
        elif what == Service.STORE:
            self.stored_node_id, self.stored_bit_rate = self.node_id, self._pending_rate
            self._answer(Service.STORE, 0)
        elif Service.INQUIRE_VENDOR <= what <= Service.INQUIRE_SERIAL:
            value = self._identity[what - Service.INQUIRE_VENDOR]
            self._send(lss.number(Service(what), value, response=True))
        elif what == Service.INQUIRE_NODE_ID:
            self._answer(Service.INQUIRE_NODE_ID, self.node_id)

    def _answer(self, service: Service, code: int) -> None:
        self._send(lss.message(service, code, response=True))

    def _activate(self, delay_ns: int) -> None:
        """Silence, the new rate after one delay, speech after the second (CiA 305, 3.9.3.3)."""
        self.quiet = True
        self._silenced()
        due_ns = self._timers.now_ns + delay_ns
        self._timers.schedule("bit rate", due_ns, self._change)
        self._timers.schedule("bit rate used", due_ns + delay_ns, self._speak)

    def _change(self) -> None:
        self.bit_rate = self._pending_rate

    def _speak(self) -> None:
        self.quiet = False
        self._silenced()
