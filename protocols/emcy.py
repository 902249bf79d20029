"""Emergency messages (CiA 301, 7.2.7): what a device reports when something breaks, and when it is whole again."""

import struct
from enum import IntEnum, IntFlag
from typing import NamedTuple

from protocols.frames import Frame

_LAYOUT = struct.Struct("<HB5s")


class Register(IntFlag):
    """Bits of the error register 0x1001 (CiA 301, table 48)."""

    GENERIC = 0x01
    CURRENT = 0x02
    VOLTAGE = 0x04
    TEMPERATURE = 0x08
    COMMUNICATION = 0x10
    PROFILE = 0x20
    MANUFACTURER = 0x80


class Code(IntEnum):
    """Error codes that armrig's devices send (CiA 301, table 26; CiA 402-2, table 18).

    `SYNC_JUMP` is ours in the class of 0x8700: the SYNC counter left out a value or repeated one. A warning.
    """

    NONE = 0x0000
    OVERCURRENT = 0x2310
    DC_LINK_OVERVOLTAGE = 0x3210
    DC_LINK_UNDERVOLTAGE = 0x3220
    DRIVE_OVERTEMPERATURE = 0x4310
    ENCODER = 0x7305
    HEARTBEAT_LOST = 0x8130
    BUS_OFF_RECOVERED = 0x8140
    PDO_LENGTH = 0x8210
    SYNC_LENGTH = 0x8240
    RPDO_TIMEOUT = 0x8250
    FOLLOWING_ERROR = 0x8611
    SYNC_LOST = 0x8700
    SYNC_JUMP = 0x8701


_CLASS = {  # first digits of the code, longest match first
    0x86: Register.PROFILE,
    0x87: Register.PROFILE,
    0x8: Register.COMMUNICATION,
    0x2: Register.CURRENT,
    0x3: Register.VOLTAGE,
    0x4: Register.TEMPERATURE,
    0x7: Register.PROFILE,
    0xF: Register.MANUFACTURER,
}


def register_of(code: int) -> Register:
    """Bits an error of that code sets in 0x1001; the generic bit is always among them."""
    if code == Code.NONE:
        return Register(0)
    return Register.GENERIC | _CLASS.get(code >> 8, _CLASS.get(code >> 12, Register.GENERIC))


# Reported by a drive that goes on working.
WARNINGS = frozenset({Code.SYNC_LENGTH, Code.SYNC_JUMP, Code.PDO_LENGTH, Code.RPDO_TIMEOUT, Code.BUS_OFF_RECOVERED})


class Emergency(NamedTuple):
    """Content of one message.

    Attributes:
        code: Error code; 0 when an error has gone.
        register: 0x1001 at that moment.
        detail: Five manufacturer bytes.
    """

    code: int
    register: int
    detail: bytes = bytes(5)


def encode(cob_id: int, emergency: Emergency) -> Frame:
    return Frame(cob_id, _LAYOUT.pack(*emergency))


def decode(data: bytes) -> Emergency | None:
    """Content of a message; None where it is not eight bytes long."""
    return Emergency(*_LAYOUT.unpack(data)) if len(data) == _LAYOUT.size else None
