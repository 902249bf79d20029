"""Layer setting services (CiA 305): how a device gets its node-id and bit rate over the bus it is to use them on."""

import struct
from enum import IntEnum
from typing import NamedTuple

from protocols.frames import Frame

REQUEST = 0x7E5  # from the master
RESPONSE = 0x7E4  # from the devices

UNCONFIGURED = 0xFF  # node-id of a device without one: it does nothing but LSS

BIT_RATES = (1_000_000, 800_000, 500_000, 250_000, 125_000, None, 50_000, 20_000, 10_000)  # table 0; 5 is reserved


class Service(IntEnum):
    """Command specifiers."""

    SWITCH_GLOBAL = 0x04
    NODE_ID = 0x11
    BIT_TIMING = 0x13
    ACTIVATE_BIT_TIMING = 0x15
    STORE = 0x17
    SWITCH_VENDOR = 0x40
    SWITCH_PRODUCT = 0x41
    SWITCH_REVISION = 0x42
    SWITCH_SERIAL = 0x43
    SWITCHED = 0x44
    IDENTIFY_VENDOR = 0x46
    IDENTIFY_PRODUCT = 0x47
    IDENTIFY_REVISION_LOW = 0x48
    IDENTIFY_REVISION_HIGH = 0x49
    IDENTIFY_SERIAL_LOW = 0x4A
    IDENTIFY_SERIAL_HIGH = 0x4B
    IDENTIFY_UNCONFIGURED = 0x4C
    IDENTIFIED = 0x4F
    UNCONFIGURED_IDENTIFIED = 0x50
    FASTSCAN = 0x51
    INQUIRE_VENDOR = 0x5A
    INQUIRE_PRODUCT = 0x5B
    INQUIRE_REVISION = 0x5C
    INQUIRE_SERIAL = 0x5D
    INQUIRE_NODE_ID = 0x5E


class Mode(IntEnum):
    """States of a device (CiA 305, 3.5)."""

    WAITING = 0
    CONFIGURATION = 1


class Identity(NamedTuple):
    """LSS address, the content of 0x1018."""

    vendor: int
    product: int
    revision: int
    serial: int


_NUMBER = struct.Struct("<BI3x")
_SCAN = struct.Struct("<BIBBB")
_BYTES = struct.Struct("<BBBB4x")


def message(service: Service, a: int = 0, b: int = 0, c: int = 0, *, response: bool = False) -> Frame:
    """Message with up to three parameter bytes."""
    return Frame(RESPONSE if response else REQUEST, _BYTES.pack(service, a, b, c))


def number(service: Service, value: int, *, response: bool = False) -> Frame:
    """Message with a 32-bit parameter."""
    return Frame(RESPONSE if response else REQUEST, _NUMBER.pack(service, value))


def value_of(data: bytes) -> int:
    """The 32-bit parameter of a message."""
    value: int = _NUMBER.unpack(data)[1]
    return value


def select(identity: Identity) -> list[Frame]:
    """Put the one device with this address into configuration; it answers the last message with `SWITCHED`."""
    return [number(Service(Service.SWITCH_VENDOR + i), value) for i, value in enumerate(identity)]


class Scan(NamedTuple):
    """One question of the fast scan: whose part `sub` of the address has these bits, from the highest down to `bit`?

    Attributes:
        bit: Lowest bit that is compared; 128 asks for any device without a node-id.
        next_sub: Part that the question after this one is about.
    """

    number: int
    bit: int
    sub: int
    next_sub: int

    def encode(self) -> Frame:
        return Frame(REQUEST, _SCAN.pack(Service.FASTSCAN, *self))

    @classmethod
    def decode(cls, data: bytes) -> "Scan":
        return cls(*_SCAN.unpack(data)[1:])


ANY = 128  # `Scan.bit`
