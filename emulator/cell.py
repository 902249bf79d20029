"""The cell's Modbus/TCP device, in a thread of its own: no client can delay the emulated rig.

pymodbus 3.16.1 answers malformed requests with function code 0x80 and only the first of several requests in one
segment; a client that sends neither never notices.
"""

import asyncio
import concurrent.futures
import errno
import logging
import socket
import threading
from typing import cast

from pymodbus.constants import ExcCodes
from pymodbus.pdu.device import ModbusDeviceIdentification
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice
from pymodbus.simulator.simdevice import SimAction

from protocols import rig
from protocols.cell import LATCH, CellState, encode
from protocols.errors import PeerError

START_S = 5.0
_READ_DISCRETE, _READ_INPUT, _WRITE_HOLDING = 2, 4, 16  # function codes; they also name the table to pymodbus
_HOLDING_WRITES = (6, 16, 22, 23)


class CellServer:
    """A Modbus/TCP server with the cell's registers.

    Args:
        config: Host, port (0 picks a free one) and unit.
        state: What the registers hold before the first `update`.
    """

    def __init__(self, config: rig.Cell, state: CellState | None = None) -> None:
        self._config = config
        self._state = state or CellState()
        self._updates = 0
        self._latched = self._state.emergency_stop
        self._own_write = False
        self._thread: threading.Thread | None = None
        self._bound: concurrent.futures.Future[int] = concurrent.futures.Future()
        self._last: concurrent.futures.Future[None] | None = None
        self._loop: asyncio.AbstractEventLoop
        self._ending: asyncio.Event
        self._server: ModbusTcpServer
        # Clients that ask wrongly are theirs to debug; pymodbus would dump every such packet into our log.
        logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)

    @property
    def port(self) -> int:
        """The port in use, once started."""
        return self._bound.result(START_S)

    @property
    def latched(self) -> bool:
        """An emergency stop has not been acknowledged by a client."""
        return self._latched

    def start(self) -> None:
        """Listen; returns when clients can connect.

        Raises:
            PeerError: The address cannot be listened on.
        """
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), name="armrig-cell", daemon=True)
        self._thread.start()
        self._bound.result(START_S)

    def stop(self) -> None:
        """Disconnect everyone and end the thread."""
        if self._thread is None:
            return
        if self._bound.exception(START_S) is None:
            self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join()
        self._thread = None

    def update(self, state: CellState) -> None:
        """Give clients new values; each call is one heartbeat. Returns at once.

        An emergency stop in `state` also sets the latch, which only a client can clear.
        """
        if self._last is not None and self._last.done():
            self._last.result()
        self._last = asyncio.run_coroutine_threadsafe(self._store(state), self._loop)

    async def _serve(self) -> None:
        address = (self._config.host, self._config.port)
        # A unit that is not there gets the answer of a gateway (exception 11), not pymodbus' "device failure".
        devices = [self._device(self._config.unit, self._veto), self._device(0, _nobody)]
        names = {"VendorName": "armrig", "ProductName": "emulated cell"}
        identity = ModbusDeviceIdentification(info_name=names)  # type: ignore[no-untyped-call]
        self._server = ModbusTcpServer(devices, address=address, identity=identity)
        try:
            await self._server.serve_forever(background=True)
        except RuntimeError:
            self._bound.set_exception(_why_not(self._config))
            return
        self._loop, self._ending = asyncio.get_running_loop(), asyncio.Event()
        await self._store(self._state)
        listener = cast(asyncio.Server, self._server.transport)
        self._bound.set_result(listener.sockets[0].getsockname()[1])
        try:
            await self._ending.wait()
        finally:
            await self._server.shutdown()  # type: ignore[no-untyped-call]

    @staticmethod
    def _device(unit: int, action: SimAction) -> SimDevice:
        words, bits = encode(CellState(), 0, 0)
        return SimDevice(
            id=unit,
            simdata=(
                [SimData(0, values=[False], datatype=DataType.BITS)],
                [SimData(0, values=bits, datatype=DataType.BITS)],
                [SimData(LATCH, values=[0], datatype=DataType.REGISTERS)],
                [SimData(0, values=words, datatype=DataType.REGISTERS)],
            ),
            action=action,
        )

    async def _store(self, state: CellState) -> None:
        """One update; runs in the server's loop without a pause, so no client reads half of it."""
        self._state = state
        self._updates += 1
        words, bits = encode(state, heartbeat=self._updates, sequence=self._updates)
        self._own_write = True
        try:
            unit = self._config.unit
            await self._server.async_setValues(unit, _READ_INPUT, 0, words)
            await self._server.async_setValues(unit, _READ_DISCRETE, 0, bits)
            if state.emergency_stop:
                self._latched = True
                await self._server.async_setValues(unit, _WRITE_HOLDING, LATCH, [1])
        finally:
            self._own_write = False

    async def _veto(
        self, function: int, _start: int, _address: int, _count: int, _now: list[int], values: object
    ) -> ExcCodes | None:
        """Acknowledging means writing 0, and only once the button is released."""
        if values is None or function not in _HOLDING_WRITES or self._own_write:
            return None
        if values != [0] or self._state.emergency_stop:
            return ExcCodes.ILLEGAL_VALUE
        self._latched = False
        return None


async def _nobody(*_: object) -> ExcCodes:
    return ExcCodes.GATEWAY_NO_RESPONSE


def _why_not(config: rig.Cell) -> PeerError:
    """pymodbus keeps the reason to itself; binding once more tells it."""
    place = f"the cell's Modbus port {config.host}:{config.port}"
    family = socket.AF_INET6 if ":" in config.host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((config.host, config.port))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return PeerError(
                    f"{place} is in use by another process, perhaps another emulated rig. Stop that one, or change"
                    " [cell] port in the rig file."
                )
            return PeerError(
                f"{place} cannot be listened on: {error.strerror or error}. Change [cell] in the rig file."
            )
    return PeerError(f"{place} could not be listened on, and is free now. Start again.")
