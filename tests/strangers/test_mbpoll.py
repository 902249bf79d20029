"""The cell, read and written by mbpoll (libmodbus)."""

import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace

import pytest

from emulator.cell import CellServer
from protocols import rig
from protocols.cell import BY_NAME, INPUT_COUNT, LATCH, CellState

pytestmark = [
    pytest.mark.stranger,
    pytest.mark.skipif(shutil.which("mbpoll") is None, reason="mbpoll is absent: apt-get install mbpoll"),
]
STATE = CellState((25.3, -4.0), 21.5, 325.4, emergency_stop=False, brake_released=True)
COILS, DISCRETE, INPUT, HOLDING = "0", "1", "3", "4"  # mbpoll's numbers of the tables


@pytest.fixture
def server() -> Iterator[CellServer]:
    server = CellServer(rig.Cell(port=0, unit=3), STATE)
    server.start()
    yield server
    server.stop()


def mbpoll(server: CellServer, table: str, address: int, *more: str, unit: int = 3) -> tuple[int, str]:
    """Exit code and all that it prints; address from 0, 2 s of patience."""
    where = ["-m", "tcp", "-p", str(server.port), "-a", str(unit), "-0", "-r", str(address), "-t", table, "-o", "2"]
    done = subprocess.run(["mbpoll", *where, *more], check=False, capture_output=True, text=True, timeout=20)
    return done.returncode, done.stdout + done.stderr


def read(server: CellServer, table: str, address: int, count: int = 1, unit: int = 3) -> tuple[int, str]:
    return mbpoll(server, table, address, "-1", "-c", str(count), "127.0.0.1", unit=unit)


def write(server: CellServer, table: str, address: int, value: int) -> tuple[int, str]:
    return mbpoll(server, table, address, "127.0.0.1", str(value))


def values(text: str) -> dict[int, int]:
    """Lines like `[3]: \\t215`, or `[5]: \\t65496 (-40)` for what is negative as a 16-bit integer."""
    rows = [line.split(":") for line in text.splitlines() if line.startswith("[")]
    return {int(where[1:-1]): int(what.split()[0]) for where, what in rows}


def test_input_registers(server: CellServer) -> None:
    code, text = read(server, INPUT, 0, INPUT_COUNT)
    assert code == 0
    words = values(text)
    assert len(words) == INPUT_COUNT
    assert words[BY_NAME["supply_voltage"].address] == 3254
    assert words[BY_NAME["ambient_temperature"].address] == 215
    assert words[BY_NAME["motor_temperature_1"].address] == 253
    assert words[BY_NAME["motor_temperature_2"].address] == 65536 - 40
    assert words[BY_NAME["motor_temperature_3"].address] == 0x8000  # not fitted
    assert words[BY_NAME["sequence_first"].address] == words[BY_NAME["sequence_last"].address] == 1


def test_discrete_inputs(server: CellServer) -> None:
    code, text = read(server, DISCRETE, 0, 2)
    assert code == 0
    assert values(text) == {0: 0, 1: 1}


def test_acknowledging_an_emergency_stop(server: CellServer) -> None:
    server.update(replace(STATE, emergency_stop=True))
    while values(read(server, HOLDING, LATCH)[1]) != {LATCH: 1}:
        pass
    code, text = write(server, HOLDING, LATCH, 0)
    assert code == 1
    assert "Illegal data value" in text
    server.update(STATE)
    while values(read(server, DISCRETE, 0)[1]) != {0: 0}:
        pass
    assert values(read(server, HOLDING, LATCH)[1]) == {LATCH: 1}
    code, text = write(server, HOLDING, LATCH, 0)
    assert code == 0, text
    assert values(read(server, HOLDING, LATCH)[1]) == {LATCH: 0}


def test_the_lamp_keeps_what_it_is_told(server: CellServer) -> None:
    assert write(server, COILS, 0, 1)[0] == 0
    assert values(read(server, COILS, 0)[1]) == {0: 1}


def test_what_is_not_there(server: CellServer) -> None:
    code, text = read(server, INPUT, INPUT_COUNT)
    assert code == 1
    assert "Illegal data address" in text
    code, text = read(server, INPUT, 0, unit=9)
    assert code == 1
    assert "Target device failed to respond" in text
