"""Error frames of SocketCAN (linux/can/error.h): what a CAN controller reports about itself and its bus.

They never were on the wire: a controller hands them to its own host. The emulated bus speaks the same language.
"""

from enum import IntEnum, IntFlag
from typing import NamedTuple

from protocols.frames import ERROR, ID_MASK, Frame


class Class(IntFlag):
    """Bits of the identifier."""

    TX_TIMEOUT = 0x001
    LOST_ARBITRATION = 0x002
    CONTROLLER = 0x004
    PROTOCOL = 0x008
    TRANSCEIVER = 0x010
    NO_ACK = 0x020
    BUS_OFF = 0x040
    BUS_ERROR = 0x080
    RESTARTED = 0x100
    COUNTERS = 0x200


class Status(IntFlag):
    """Bits of data byte 1 where the class is `CONTROLLER`."""

    NONE = 0x00
    RX_OVERFLOW = 0x01
    TX_OVERFLOW = 0x02
    RX_WARNING = 0x04
    TX_WARNING = 0x08
    RX_PASSIVE = 0x10
    TX_PASSIVE = 0x20
    ACTIVE = 0x40


class State(IntEnum):
    """Fault confinement states (ISO 11898-1, 10.13), and the warning level that controllers add."""

    ACTIVE = 0
    WARNING = 1
    PASSIVE = 2
    BUS_OFF = 3


class Report(NamedTuple):
    """Meaning of an error frame.

    Attributes:
        classes: What it is about.
        state: The controller's state from now on; None where the frame does not tell.
        tec, rec: Transmit and receive error counters; None where the frame does not tell.
        station: Which of several controllers behind one interface it concerns (data byte 5, the manufacturer's own);
            0 for all, and everywhere but on the emulated bus.
        text: In words, with numbers.
    """

    classes: Class
    state: State | None
    tec: int | None
    rec: int | None
    station: int
    text: str


_WORDS = {
    Class.TX_TIMEOUT: "transmission timed out",
    Class.LOST_ARBITRATION: "arbitration lost",
    Class.TRANSCEIVER: "transceiver problem",
    Class.NO_ACK: "no acknowledgement: nobody else is on the bus",
    Class.BUS_OFF: "BUS OFF: the controller has left the bus",
    Class.BUS_ERROR: "bus error",
    Class.RESTARTED: "controller restarted",
}
_STATUS_WORDS = {
    Status.RX_OVERFLOW: "receive buffer overflow: frames are lost",
    Status.TX_OVERFLOW: "transmit buffer overflow: frames are lost",
    Status.RX_WARNING: "many receive errors",
    Status.TX_WARNING: "many transmit errors",
    Status.RX_PASSIVE: "error passive by receive errors",
    Status.TX_PASSIVE: "error passive by transmit errors",
    Status.ACTIVE: "error active again",
}
_PROTOCOL_WORDS = {  # bits of data byte 2
    0x01: "single bit",
    0x02: "frame format",
    0x04: "bit stuffing",
    0x08: "dominant bit not sent",
    0x10: "recessive bit not sent",
    0x20: "bus overload",
    0x40: "active error announcement",
    0x80: "occurred on transmission",
}


def encode(
    classes: Class, status: Status = Status.NONE, *, tec: int | None = None, rec: int = 0, station: int = 0
) -> Frame:
    """Error frame; with counters where `tec` is given."""
    data = bytearray(8)
    data[1], data[5] = status, station
    if tec is not None:
        classes |= Class.COUNTERS
        data[6], data[7] = min(tec, 255), min(rec, 255)
    return Frame(ERROR | classes, bytes(data))


def decode(frame: Frame) -> Report:
    """Meaning of a frame with the `ERROR` flag; short ones mean what their identifier says."""
    classes = Class(frame.can_id & ID_MASK)
    data = frame.data.ljust(8, b"\0")
    said: list[str] = []
    if classes & Class.CONTROLLER:
        status = Status(data[1])
        said += [text for bit, text in _STATUS_WORDS.items() if status & bit] or ["controller problem"]
    if classes & Class.PROTOCOL:
        kinds = [text for bit, text in _PROTOCOL_WORDS.items() if data[2] & bit]
        said.append(f"protocol violation ({', '.join(kinds)})" if kinds else "protocol violation")
    said += [text for bit, text in _WORDS.items() if classes & bit]
    tec, rec = (data[6], data[7]) if classes & Class.COUNTERS else (None, None)
    if tec is not None:
        said.append(f"{tec} transmit and {rec} receive errors counted")
    return Report(classes, _state(classes, data[1]), tec, rec, data[5], ", ".join(said) or "unknown error")


def _state(classes: Class, status: int) -> State | None:
    if classes & Class.BUS_OFF:
        return State.BUS_OFF
    if classes & Class.RESTARTED:
        return State.ACTIVE
    if classes & Class.CONTROLLER:
        if status & (Status.RX_PASSIVE | Status.TX_PASSIVE):
            return State.PASSIVE
        if status & (Status.RX_WARNING | Status.TX_WARNING):
            return State.WARNING
        if status & Status.ACTIVE:
            return State.ACTIVE
    return None
