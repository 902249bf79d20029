"""Modbus register map of the cell: one table, from which both ends encode and decode.

Modbus has no snapshot of several registers: `sequence_first` and `sequence_last` enclose the input registers, and a
reader that finds them different has read across an update (a torn read). `heartbeat` tells a cell that stands still
from one that works. The emergency stop is information here, not a safety function.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import msgspec

MAX_MOTORS = 12
NOT_FITTED = -0x8000  # temperature word of a motor the arm does not have
_U16 = 0x1_0000
_I16_MAX = 0x7FFF


class Kind(StrEnum):
    """The four Modbus tables."""

    COIL = "coil"
    DISCRETE = "discrete input"
    HOLDING = "holding register"
    INPUT = "input register"


class Register(msgspec.Struct, frozen=True):
    """A row of the map.

    Attributes:
        address: As on the wire, from 0; manuals that count from 1 say one more.
        type: `bit`, `u16` or `i16` (two's complement).
        scale: Physical value of one count.
    """

    name: str
    kind: Kind
    address: int
    type: str
    scale: float
    unit: str
    meaning: str


REGISTERS: tuple[Register, ...] = (
    Register("signal_lamp", Kind.COIL, 0, "bit", 1, "", "free for clients; the cell only keeps it"),
    Register("emergency_stop", Kind.DISCRETE, 0, "bit", 1, "", "1 while the button is pressed"),
    Register("brake_released", Kind.DISCRETE, 1, "bit", 1, "", "1 while the arm's brakes are open"),
    Register(
        "emergency_stop_latch",
        Kind.HOLDING,
        0,
        "u16",
        1,
        "",
        "1 from an emergency stop until a client writes 0; refused with exception 3 while the button is pressed",
    ),
    Register("sequence_first", Kind.INPUT, 0, "u16", 1, "", "counts updates; equals sequence_last in a sound read"),
    Register("heartbeat", Kind.INPUT, 1, "u16", 1, "", "counts updates of the cell's program"),
    Register("supply_voltage", Kind.INPUT, 2, "u16", 0.1, "V", "of the drives' DC link"),
    Register("ambient_temperature", Kind.INPUT, 3, "i16", 0.1, "degC", "of the cell's air"),
    *(
        Register(
            f"motor_temperature_{n}", Kind.INPUT, 3 + n, "i16", 0.1, "degC", f"winding of motor {n}; -32768: not fitted"
        )
        for n in range(1, MAX_MOTORS + 1)
    ),
    Register("sequence_last", Kind.INPUT, 4 + MAX_MOTORS, "u16", 1, "", "see sequence_first"),
)
BY_NAME = {register.name: register for register in REGISTERS}
INPUT_COUNT = sum(register.kind is Kind.INPUT for register in REGISTERS)
DISCRETE_COUNT = sum(register.kind is Kind.DISCRETE for register in REGISTERS)
LATCH = BY_NAME["emergency_stop_latch"].address


@dataclass(frozen=True, slots=True)
class CellState:
    """What the cell measures.

    Attributes:
        motor_temperature_C: One per joint, up to `MAX_MOTORS`.
        supply_V: DC link of the drives.
        emergency_stop: The button is pressed.
    """

    motor_temperature_C: tuple[float, ...] = ()
    ambient_temperature_C: float = 20.0
    supply_V: float = 325.0  # rectified 230 V mains
    emergency_stop: bool = False
    brake_released: bool = False

    def __post_init__(self) -> None:
        if len(self.motor_temperature_C) > MAX_MOTORS:
            raise ValueError(f"{len(self.motor_temperature_C)} motors, but the register map has room for {MAX_MOTORS}")


class Reading(NamedTuple):
    """What a client has read.

    Attributes:
        latched: An emergency stop has not been acknowledged.
    """

    state: CellState
    latched: bool
    heartbeat: int
    sequence: int


class TornReadError(ValueError):
    """The registers were read while the cell wrote them."""


def encode(state: CellState, heartbeat: int, sequence: int) -> tuple[list[int], list[bool]]:
    """Input registers and discrete inputs, both from address 0. Values beyond a register's range are clipped to it."""
    motors = [_to_word("motor_temperature_1", t) for t in state.motor_temperature_C]
    words = [
        sequence % _U16,
        heartbeat % _U16,
        _to_word("supply_voltage", state.supply_V),
        _to_word("ambient_temperature", state.ambient_temperature_C),
        *motors,
        *[NOT_FITTED % _U16] * (MAX_MOTORS - len(motors)),
        sequence % _U16,
    ]
    return words, [state.emergency_stop, state.brake_released]


def decode(inputs: Sequence[int], discrete: Sequence[bool], latch: int) -> Reading:
    """What the registers say.

    Args:
        inputs: All input registers, shape (INPUT_COUNT,).
        discrete: At least `DISCRETE_COUNT` discrete inputs.
        latch: The holding register.

    Raises:
        TornReadError: The sequence registers differ.
    """
    if inputs[0] != inputs[-1]:
        raise TornReadError(f"sequence {inputs[0]} at the beginning of the read, {inputs[-1]} at its end")
    motors = [word for word in inputs[4 : 4 + MAX_MOTORS] if word != NOT_FITTED % _U16]
    state = CellState(
        motor_temperature_C=tuple(_to_value("motor_temperature_1", word) for word in motors),
        ambient_temperature_C=_to_value("ambient_temperature", inputs[3]),
        supply_V=_to_value("supply_voltage", inputs[2]),
        emergency_stop=bool(discrete[0]),
        brake_released=bool(discrete[1]),
    )
    return Reading(state, bool(latch), inputs[1], inputs[0])


def _to_word(name: str, value: float) -> int:
    register = BY_NAME[name]
    count = round(value / register.scale)
    if register.type == "u16":
        return min(max(count, 0), _U16 - 1)
    return min(max(count, NOT_FITTED + 1), _I16_MAX) % _U16


def _to_value(name: str, word: int) -> float:
    register = BY_NAME[name]
    count = word - _U16 if register.type == "i16" and word > _I16_MAX else word
    return count / round(1 / register.scale)  # 253 / 10 is 25.3; 253 * 0.1 is not


def to_json() -> bytes:
    """The map for people who write clients in other languages."""
    return msgspec.json.format(msgspec.json.encode(REGISTERS), indent=2)
