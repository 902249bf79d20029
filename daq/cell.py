"""Edge: poll the cell over Modbus/TCP, in a thread of its own so that a silent cell never delays the frames."""

import asyncio
import contextlib
import logging
import threading
from collections.abc import Callable

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU

from protocols import rig
from protocols.cell import DISCRETE_COUNT, INPUT_COUNT, LATCH, Reading, TornReadError, decode
from protocols.clock import Clock
from protocols.topics import INFO, WARNING, CellSample, Event

TIMEOUT_S = 0.3  # a healthy cell answers within 20 ms
FROZEN_NS = (
    1_000_000_000  # a heartbeat this old means that the cell's program stands still though its network card answers
)


class CellPoller:
    """Reads the cell at a fixed rate.

    Every poll gives a `CellSample`; one that failed repeats the last values and is marked stale. A change between
    answering and not answering, or of a heartbeat between counting and not counting, is an event.

    Args:
        config: Where the cell is, how often to ask.
        put: Takes samples and events; called from the poller's thread, must not block.
    """

    def __init__(self, config: rig.Cell, clock: Clock, put: Callable[[CellSample | Event], None]) -> None:
        self._config = config
        self._clock = clock
        self._put = put
        self._thread = threading.Thread(target=lambda: asyncio.run(self._poll()), name="armrig-cell", daemon=True)
        self._running = threading.Event()
        self._loop: asyncio.AbstractEventLoop
        self._ending: asyncio.Event
        self._last: Reading | None = None
        self._failures = 0
        self._failing_since_ns = 0
        self._beat_ns = 0
        self._frozen = False
        # Failures are events of the recording; pymodbus would print each poll's on stderr too.
        logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)

    def start(self) -> None:
        """Begin to poll; a cell that does not answer yet is an event, not an error."""
        self._thread.start()
        self._running.wait()

    def stop(self) -> None:
        """End the thread; takes at most one timeout."""
        if self._running.is_set():
            self._loop.call_soon_threadsafe(self._ending.set)
            self._running.clear()
            self._thread.join()

    async def _poll(self) -> None:
        self._loop, self._ending = asyncio.get_running_loop(), asyncio.Event()
        self._running.set()
        client = AsyncModbusTcpClient(
            self._config.host, port=self._config.port, timeout=TIMEOUT_S, retries=0, reconnect_delay=0
        )
        period_s, due_s = 1 / self._config.poll_Hz, self._loop.time()
        while not self._ending.is_set():
            try:
                reading = await self._read(client)
            except (ModbusException, TornReadError, OSError) as error:
                self._failed(str(error))
            else:
                self._succeeded(reading)
            due_s = max(due_s + period_s, self._loop.time())  # after a timeout: late, but no burst of polls
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._ending.wait(), due_s - self._loop.time())
        client.close()

    async def _read(self, client: AsyncModbusTcpClient) -> Reading:
        if not client.connected and not await client.connect():
            raise ConnectionError("it does not accept a connection")
        unit = self._config.unit
        inputs = _answer(await client.read_input_registers(0, count=INPUT_COUNT, device_id=unit))
        discrete = _answer(await client.read_discrete_inputs(0, count=DISCRETE_COUNT, device_id=unit))
        latch = _answer(await client.read_holding_registers(LATCH, count=1, device_id=unit))
        return decode(inputs.registers, discrete.bits, latch.registers[0])

    def _succeeded(self, reading: Reading) -> None:
        t_ns = self._clock.now_ns()
        if self._failures:
            lost_s = (t_ns - self._failing_since_ns) * 1e-9
            self._event(t_ns, INFO, f"answers again after {self._failures} failed polls ({lost_s:.1f} s)")
            self._failures = 0
        elif self._last is None:
            self._event(t_ns, INFO, f"answers at {self._config.host}:{self._config.port}")
        if self._last is None or reading.heartbeat != self._last.heartbeat:
            if self._frozen:
                self._event(t_ns, INFO, f"heartbeat counts again after {(t_ns - self._beat_ns) * 1e-9:.1f} s")
            self._beat_ns, self._frozen = t_ns, False
        elif not self._frozen and t_ns - self._beat_ns > FROZEN_NS:
            self._frozen = True
            text = f"heartbeat stands at {reading.heartbeat} for {(t_ns - self._beat_ns) * 1e-9:.1f} s"
            self._event(t_ns, WARNING, f"{text}: the cell's program has stopped. Samples until it counts are stale.")
        self._last = reading
        self._sample(t_ns, reading, stale=self._frozen)

    def _failed(self, reason: str) -> None:
        t_ns = self._clock.now_ns()
        if not self._failures:
            self._failing_since_ns = t_ns
            place = f"{self._config.host}:{self._config.port}"
            self._event(t_ns, WARNING, f"no reading from {place}: {reason}. Samples until it answers are stale.")
        self._failures += 1
        if self._last is not None:
            self._sample(t_ns, self._last, stale=True)

    def _sample(self, t_ns: int, reading: Reading, *, stale: bool) -> None:
        state = reading.state
        self._put(
            CellSample(
                t_ns=t_ns,
                motor_temperature_C=state.motor_temperature_C,
                ambient_temperature_C=state.ambient_temperature_C,
                supply_V=state.supply_V,
                emergency_stop=state.emergency_stop or reading.latched,  # shorter presses than a period count too
                brake_released=state.brake_released,
                heartbeat=reading.heartbeat,
                sequence=reading.sequence,
                stale=stale,
            )
        )

    def _event(self, t_ns: int, level: int, text: str) -> None:
        self._put(Event(t_ns, level, "cell", text))


def _answer(answer: ModbusPDU) -> ModbusPDU:
    if answer.isError():
        raise ModbusException(f"it refuses the read: {answer}")
    return answer
