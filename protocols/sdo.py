"""Service data objects (CiA 301, 7.2.4): reading and writing a device's dictionary, expedited or in segments.

Bytes in, bytes out: `Server` answers requests, `Upload` and `Download` are the two things a client does. Whoever
owns the bus sends what they return and watches the clock.
"""

import struct
from enum import IntEnum
from typing import Protocol

from protocols.errors import PeerError

FRAME_BYTES = 8
SEGMENT_BYTES = 7
EXPEDITED_BYTES = 4

_HEAD = struct.Struct("<BHB4s")
_CODE = struct.Struct("<BHBI")

_SEGMENT = (0, 3)  # command specifiers of a client, top three bits of the first byte: segment down, segment up
_ABORT = 4


class Abort(IntEnum):
    """Abort codes (CiA 301, table 22)."""

    TOGGLE = 0x0503_0000
    TIMEOUT = 0x0504_0000
    COMMAND = 0x0504_0001
    BLOCK_SIZE = 0x0504_0002
    SEQUENCE = 0x0504_0003
    CRC = 0x0504_0004
    WRITE_ONLY = 0x0601_0001
    READ_ONLY = 0x0601_0002
    NO_OBJECT = 0x0602_0000
    NOT_MAPPABLE = 0x0604_0041
    PDO_LENGTH = 0x0604_0042
    INCOMPATIBLE = 0x0604_0043
    LENGTH = 0x0607_0010
    TOO_LONG = 0x0607_0012
    TOO_SHORT = 0x0607_0013
    NO_SUBINDEX = 0x0609_0011
    VALUE = 0x0609_0030
    TOO_HIGH = 0x0609_0031
    TOO_LOW = 0x0609_0032
    GENERAL = 0x0800_0000
    NOT_STORED = 0x0800_0020
    STATE = 0x0800_0022
    NO_DATA = 0x0800_0024


_MEANING = {
    Abort.TOGGLE: "the toggle bit did not alternate",
    Abort.TIMEOUT: "no answer in time",
    Abort.COMMAND: "unknown or unexpected command specifier",
    Abort.BLOCK_SIZE: "a block must have 1 to 127 segments",
    Abort.SEQUENCE: "a segment number that cannot be",
    Abort.CRC: "the checksum of the block transfer is wrong",
    Abort.WRITE_ONLY: "the object cannot be read",
    Abort.READ_ONLY: "the object cannot be written",
    Abort.NO_OBJECT: "there is no such object",
    Abort.NOT_MAPPABLE: "the object cannot be mapped to a PDO",
    Abort.PDO_LENGTH: "the mapped objects exceed the length of a PDO",
    Abort.INCOMPATIBLE: "the value contradicts another parameter",
    Abort.LENGTH: "length of data and of object differ",
    Abort.TOO_LONG: "too many bytes for the object",
    Abort.TOO_SHORT: "too few bytes for the object",
    Abort.NO_SUBINDEX: "there is no such sub-index",
    Abort.VALUE: "the value is not allowed",
    Abort.TOO_HIGH: "the value is above the object's limit",
    Abort.TOO_LOW: "the value is below the object's limit",
    Abort.GENERAL: "general error",
    Abort.NOT_STORED: "the data cannot be transferred or stored",
    Abort.STATE: "not possible in the present device state",
    Abort.NO_DATA: "no data available",
}


class SdoError(PeerError):
    """A transfer that ended without success.

    Attributes:
        code: Usually an `Abort`; a number where a foreign device invents its own.
        index, sub: The object; 0 where the side that aborts does not know it.
        received: The other side aborted. If not, it has to be told: send `encode()`.
    """

    def __init__(self, code: int, index: int = 0, sub: int = 0, *, received: bool = False) -> None:
        meaning = _MEANING.get(Abort(code), "") if code in _CODES else "a code outside CiA 301"
        super().__init__(f"SDO transfer of {index:04X}:{sub:02X} aborted with {code:08X}: {meaning}.")
        self.code = code
        self.index = index
        self.sub = sub
        self.received = received

    def encode(self) -> bytes:
        """The abort message."""
        return _CODE.pack(0x80, self.index, self.sub, self.code)


_CODES = frozenset(Abort)


class Objects(Protocol):
    """What a server needs of a dictionary. Every method may raise `SdoError`; the server adds index and sub-index."""

    def read(self, index: int, sub: int) -> bytes:
        """Value as it goes over the bus."""

    def sizes(self, index: int, sub: int) -> tuple[int, int]:
        """Fewest and most bytes a download may have; refuses what cannot be written at all."""

    def write(self, index: int, sub: int, data: bytes) -> None:
        """Store a value."""


class _Transfer:
    """One segmented transfer in progress.

    Attributes:
        sizes: Fewest and most bytes; equal where the length was announced.
        data: Bytes received so far, or to be sent.
        sent: How many bytes of an upload have left.
        toggle: Toggle bit of the next segment, 0 or 0x10.
    """

    __slots__ = ("data", "index", "sent", "sizes", "sub", "toggle", "upload")

    def __init__(self, index: int, sub: int, sizes: tuple[int, int], data: bytes, *, upload: bool) -> None:
        self.index = index
        self.sub = sub
        self.sizes = sizes
        self.data = data
        self.upload = upload
        self.sent = 0
        self.toggle = 0

    def fail(self, code: Abort) -> SdoError:
        return SdoError(code, self.index, self.sub)

    def check_toggle(self, command: int) -> None:
        if command & 0x10 != self.toggle:
            raise self.fail(Abort.TOGGLE)
        self.toggle ^= 0x10

    def take(self, frame: bytes) -> bool:
        """Append a segment's data; returns whether it was the last."""
        self.data += frame[1 : FRAME_BYTES - (frame[0] >> 1 & 7)]
        if len(self.data) > self.sizes[1]:
            raise self.fail(Abort.TOO_LONG)
        if frame[0] & 1 and len(self.data) < self.sizes[0]:
            raise self.fail(Abort.TOO_SHORT)
        return bool(frame[0] & 1)

    def give(self, command: int) -> bytes:
        """Next segment of `data`; the lowest bit marks the last one."""
        part = self.data[self.sent : self.sent + SEGMENT_BYTES]
        self.sent += len(part)
        last = self.sent == len(self.data)
        return bytes((command | (SEGMENT_BYTES - len(part)) << 1 | last,)) + part.ljust(SEGMENT_BYTES, b"\0")


class Server:
    """The device's side: one request in, at most one response out."""

    def __init__(self, objects: Objects) -> None:
        self._objects = objects
        self._transfer: _Transfer | None = None
        self._answer = {0: self._download_segment, 1: self._download, 2: self._upload, 3: self._upload_segment}

    @property
    def busy(self) -> bool:
        """Whether a segmented transfer waits for the client: give up on it with `expire` when it takes too long."""
        return self._transfer is not None

    def receive(self, frame: bytes) -> bytes | None:
        """Response to one request; None where there is none to give (abort by the client, or not eight bytes)."""
        if len(frame) != FRAME_BYTES:
            return None
        specifier = frame[0] >> 5
        if specifier == _ABORT:
            self._transfer = None
            return None
        if specifier in _SEGMENT:
            index, sub = self._object()
        else:  # a new request ends an old transfer, whatever its state
            _, index, sub, _ = _HEAD.unpack(frame)
            self._transfer = None
        try:
            if specifier not in self._answer:
                raise SdoError(Abort.COMMAND)
            return self._answer[specifier](frame)
        except SdoError as abort:
            self._transfer = None
            return SdoError(abort.code, index, sub).encode()

    def expire(self) -> bytes | None:
        """Abort the segmented transfer in progress for want of a request."""
        if self._transfer is None:
            return None
        abort = self._transfer.fail(Abort.TIMEOUT)
        self._transfer = None
        return abort.encode()

    def reset(self) -> None:
        """Forget the transfer in progress without a word."""
        self._transfer = None

    def _object(self) -> tuple[int, int]:
        return (self._transfer.index, self._transfer.sub) if self._transfer else (0, 0)

    def _segmented(self, *, upload: bool) -> _Transfer:
        if self._transfer is None or self._transfer.upload != upload:
            raise SdoError(Abort.COMMAND)
        return self._transfer

    def _download(self, frame: bytes) -> bytes:
        command, index, sub, payload = _HEAD.unpack(frame)
        fewest, most = self._objects.sizes(index, sub)
        expedited, announced = command & 2, command & 1
        if expedited:
            size = EXPEDITED_BYTES - (command >> 2 & 3) if announced else min(most, EXPEDITED_BYTES)
        else:
            size = int.from_bytes(payload, "little") if announced else fewest
        if size < fewest:
            raise SdoError(Abort.TOO_SHORT)
        if size > most:
            raise SdoError(Abort.TOO_LONG)
        if expedited:
            self._objects.write(index, sub, payload[:size])
        else:
            sizes = (size, size) if announced else (fewest, most)
            self._transfer = _Transfer(index, sub, sizes, b"", upload=False)
        return _HEAD.pack(0x60, index, sub, bytes(4))

    def _download_segment(self, frame: bytes) -> bytes:
        transfer = self._segmented(upload=False)
        toggle = transfer.toggle
        transfer.check_toggle(frame[0])
        if transfer.take(frame):
            self._objects.write(transfer.index, transfer.sub, transfer.data)
            self._transfer = None
        return bytes((0x20 | toggle,)).ljust(FRAME_BYTES, b"\0")

    def _upload(self, frame: bytes) -> bytes:
        _, index, sub, _ = _HEAD.unpack(frame)
        data = self._objects.read(index, sub)
        if 0 < len(data) <= EXPEDITED_BYTES:
            return _HEAD.pack(0x43 | (EXPEDITED_BYTES - len(data)) << 2, index, sub, data)
        self._transfer = _Transfer(index, sub, (0, len(data)), data, upload=True)
        return _HEAD.pack(0x41, index, sub, len(data).to_bytes(4, "little"))

    def _upload_segment(self, frame: bytes) -> bytes:
        transfer = self._segmented(upload=True)
        toggle = transfer.toggle
        transfer.check_toggle(frame[0])
        answer = transfer.give(toggle)
        if answer[0] & 1:
            self._transfer = None
        return answer


class _Client:
    """What both kinds of client transfer share.

    Attributes:
        index, sub: The object.
        done: Whether the transfer has succeeded.
    """

    def __init__(self, index: int, sub: int) -> None:
        self.index = index
        self.sub = sub
        self.done = False
        self._segments: _Transfer | None = None

    def expire(self) -> SdoError:
        """The error of a server that does not answer; `encode()` of it tells the server."""
        return SdoError(Abort.TIMEOUT, self.index, self.sub)

    def _concerns(self, frame: bytes) -> bool:
        """Whether a response belongs to this transfer; a late one of an earlier transfer does not.

        Raises:
            SdoError: The server has aborted.
        """
        if len(frame) != FRAME_BYTES or self.done:
            return False
        if frame[0] >> 5 == _ABORT:
            _, index, sub, code = _CODE.unpack(frame)
            if (index, sub) not in {(self.index, self.sub), (0, 0)}:
                return False
            raise SdoError(code, self.index, self.sub, received=True)
        return self._segments is not None or _HEAD.unpack(frame)[1:3] == (self.index, self.sub)

    def _fail(self, code: Abort) -> SdoError:
        return SdoError(code, self.index, self.sub)


class Upload(_Client):
    """Read one object: send `request()`, pass every response to `receive`, take `data` when `done`.

    Attributes:
        data: The value's bytes.
    """

    def __init__(self, index: int, sub: int = 0) -> None:
        super().__init__(index, sub)
        self.data = b""

    def request(self) -> bytes:
        return _HEAD.pack(0x40, self.index, self.sub, bytes(4))

    def receive(self, frame: bytes) -> bytes | None:
        """Next request; None when there is nothing to say.

        Raises:
            SdoError: The server aborted, or answered wrongly.
        """
        if not self._concerns(frame):
            return None
        command = frame[0]
        if self._segments is not None:
            if command >> 5 != 0:
                raise self._fail(Abort.COMMAND)
            self._segments.check_toggle(command)
            if self._segments.take(frame):
                self.data, self.done = self._segments.data, True
                return None
            return self._ask(self._segments.toggle)
        if command >> 5 != 2:
            raise self._fail(Abort.COMMAND)
        payload = frame[4:]
        if command & 2:
            self.data = payload[: EXPEDITED_BYTES - (command >> 2 & 3)] if command & 1 else payload
            self.done = True
            return None
        size = int.from_bytes(payload, "little")
        sizes = (size, size) if command & 1 else (0, 2**32)
        self._segments = _Transfer(self.index, self.sub, sizes, b"", upload=True)
        return self._ask(0)

    @staticmethod
    def _ask(toggle: int) -> bytes:
        return bytes((0x60 | toggle,)).ljust(FRAME_BYTES, b"\0")


class Download(_Client):
    """Write one object: send `request()`, pass every response to `receive` until `done`."""

    def __init__(self, index: int, sub: int, data: bytes) -> None:
        super().__init__(index, sub)
        self._data = data

    def request(self) -> bytes:
        size = len(self._data)
        if 0 < size <= EXPEDITED_BYTES:
            return _HEAD.pack(0x23 | (EXPEDITED_BYTES - size) << 2, self.index, self.sub, self._data)
        return _HEAD.pack(0x21, self.index, self.sub, size.to_bytes(4, "little"))

    def receive(self, frame: bytes) -> bytes | None:
        """Next request; None when there is nothing to say.

        Raises:
            SdoError: The server aborted, or answered wrongly.
        """
        if not self._concerns(frame):
            return None
        command = frame[0]
        if self._segments is not None:
            if command >> 5 != 1:
                raise self._fail(Abort.COMMAND)
            self._segments.check_toggle(command)
            self.done = self._segments.sent == len(self._data)
        elif command >> 5 != 3:
            raise self._fail(Abort.COMMAND)
        elif 0 < len(self._data) <= EXPEDITED_BYTES:
            self.done = True
        else:
            self._segments = _Transfer(self.index, self.sub, (0, 0), self._data, upload=False)
        return None if self.done or self._segments is None else self._segments.give(self._segments.toggle)
