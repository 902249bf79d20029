"""SDO block transfers (CiA 301, 7.2.4.3.9 to 7.2.4.3.16): up to 127 segments per confirmation, with a checksum.

`BlockServer` is a `sdo.Server` that understands them as well; `BlockUpload` and `BlockDownload` are the client's side.
Where `Server` answers a request with one message at most, a block upload answers with many.
"""

import struct
from binascii import crc_hqx
from typing import Protocol

from protocols.sdo import FRAME_BYTES, SEGMENT_BYTES, Abort, Objects, SdoError, Server, Upload

MOST_SEGMENTS = 127

_HEAD = struct.Struct("<BHBI")
_END = struct.Struct("<BH5x")
_LAST = 0x80  # in a segment's first byte; the rest is its number from 1
_ABORT = 0x80  # as a first byte: segment number 0 does not exist

# First bytes: a request's lowest bits tell initiate (0), end (1), confirmation (2) and start (3) apart.
_UP, _DOWN = 5, 6  # command specifiers of a client, bits 7 to 5
_WITH_CRC, _WITH_SIZE = 4, 2


def crc(data: bytes) -> int:
    """CRC of a block transfer: x^16 + x^12 + x^5 + 1, initial value 0 (CiA 301, 7.2.4.3.16)."""
    return crc_hqx(data, 0)


def _unused(size: int) -> int:
    """Bytes without data in the last segment of `size` bytes."""
    return -size % SEGMENT_BYTES if size else SEGMENT_BYTES


class _Sender:
    """Data on their way in blocks, for server and client alike.

    Attributes:
        done: All segments have been confirmed.
    """

    def __init__(self, data: bytes) -> None:
        self.data = data
        self._confirmed = 0  # segments
        self._segments = max(1, -(-len(data) // SEGMENT_BYTES))
        self._sent = 0  # of the present block

    @property
    def done(self) -> bool:
        return self._confirmed == self._segments

    def block(self, size: int) -> list[bytes]:
        """The next block of at most `size` segments."""
        if not 1 <= size <= MOST_SEGMENTS:
            raise SdoError(Abort.BLOCK_SIZE)
        self._sent = min(size, self._segments - self._confirmed)
        segments = []
        for number in range(1, self._sent + 1):
            at = SEGMENT_BYTES * (self._confirmed + number - 1)
            last = _LAST if self._confirmed + number == self._segments else 0
            segments.append(bytes((last | number,)) + self.data[at : at + SEGMENT_BYTES].ljust(SEGMENT_BYTES, b"\0"))
        return segments

    def confirm(self, number: int) -> None:
        """The other side has everything up to this segment of the block; the rest is sent again."""
        if number > self._sent:
            raise SdoError(Abort.SEQUENCE)
        self._confirmed += number

    def end(self, specifier: int, *, with_crc: bool) -> bytes:
        """The message after the last block."""
        check = crc(self.data) if with_crc else 0
        return _END.pack(specifier << 5 | _unused(len(self.data)) << 2 | 1, check)


class _Receiver:
    """Data coming in blocks, for server and client alike.

    Attributes:
        most: Bytes that may come.
        complete: The last segment is there.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self.complete = False
        self._data = bytearray()
        self._number = 0

    def take(self, frame: bytes) -> int | None:
        """Segment of a block; returns the number to confirm when the block ends with it."""
        number, last = frame[0] & ~_LAST, bool(frame[0] & _LAST)
        if number == 0:
            raise SdoError(Abort.SEQUENCE)
        if number == self._number + 1:  # others are repeated after the confirmation
            self._number = number
            self._data += frame[1:]
            self.complete = last
            if len(self._data) >= self.most + SEGMENT_BYTES + (self.most == 0):
                raise SdoError(Abort.TOO_LONG)
        if not last and number < MOST_SEGMENTS:
            return None
        confirmed, self._number = self._number, 0
        return confirmed

    def data(self, end: bytes, *, with_crc: bool) -> bytes:
        """All that has come, checked with the message after the last block."""
        command, check = _END.unpack(end)
        unused = command >> 2 & 7
        data = bytes(self._data[: len(self._data) - unused])
        if with_crc and crc(data) != check:
            raise SdoError(Abort.CRC)
        return data


class _Conversation(Protocol):
    """A block transfer as the server holds it."""

    index: int
    sub: int
    done: bool

    def belongs(self, frame: bytes) -> bool:
        """Whether the message continues this transfer."""

    def receive(self, frame: bytes) -> list[bytes]:
        """Answers to the next message of the client."""


class _ServedDownload:
    """Block download, server's side."""

    def __init__(self, objects: Objects, frame: bytes) -> None:
        command, self.index, self.sub, size = _HEAD.unpack(frame)
        self._objects = objects
        self._fewest, most = objects.sizes(self.index, self.sub)
        if command & _WITH_SIZE:
            if size > most:
                raise SdoError(Abort.TOO_LONG)
            if size < self._fewest:
                raise SdoError(Abort.TOO_SHORT)
            self._fewest = most = size
        self._with_crc = bool(command & _WITH_CRC)
        self._receiver = _Receiver(most)
        self.done = False

    def answer(self) -> bytes:
        return _HEAD.pack(0xA0 | self._with_crc * _WITH_CRC, self.index, self.sub, MOST_SEGMENTS)

    def belongs(self, frame: bytes) -> bool:
        return not self._receiver.complete or (frame[0] >> 5 == _DOWN and bool(frame[0] & 1))

    def receive(self, frame: bytes) -> list[bytes]:
        if not self._receiver.complete:
            number = self._receiver.take(frame)
            return [] if number is None else [bytes((0xA2, number, MOST_SEGMENTS)).ljust(FRAME_BYTES, b"\0")]
        data = self._receiver.data(frame, with_crc=self._with_crc)
        if len(data) > self._receiver.most:
            raise SdoError(Abort.TOO_LONG)
        if len(data) < self._fewest:
            raise SdoError(Abort.TOO_SHORT)
        self._objects.write(self.index, self.sub, data)
        self.done = True
        return [b"\xa1".ljust(FRAME_BYTES, b"\0")]


class _ServedUpload:
    """Block upload, server's side."""

    def __init__(self, frame: bytes, data: bytes) -> None:
        command, self.index, self.sub, _ = _HEAD.unpack(frame)
        self._with_crc = bool(command & _WITH_CRC)
        self._block_size = frame[4]
        if not 1 <= self._block_size <= MOST_SEGMENTS:
            raise SdoError(Abort.BLOCK_SIZE)
        self._sender = _Sender(data)
        self._next = 3  # what the client has to say next, lowest two bits of its command
        self.done = False

    def answer(self) -> bytes:
        # A checksum is offered only to those who want one: `canopen` 2.4.1 checks it even where it has not asked.
        return _HEAD.pack(0xC2 | self._with_crc * _WITH_CRC, self.index, self.sub, len(self._sender.data))

    def belongs(self, frame: bytes) -> bool:
        return frame[0] >> 5 == _UP and frame[0] & 3 == self._next

    def receive(self, frame: bytes) -> list[bytes]:
        if self._next == 1:
            self.done = True
            return []
        if self._next == 2:
            self._sender.confirm(frame[1])
            self._block_size = frame[2]
        if self._sender.done:
            self._next = 1
            return [self._sender.end(_DOWN, with_crc=self._with_crc)]
        self._next = 2
        return self._sender.block(self._block_size)


class BlockServer:
    """The device's side of every kind of transfer: one request in, any number of responses out."""

    def __init__(self, objects: Objects) -> None:
        self._objects = objects
        self._plain = Server(objects)
        self._block: _Conversation | None = None

    @property
    def busy(self) -> bool:
        """Whether a transfer waits for the client: give up on it with `expire` when it takes too long."""
        return self._block is not None or self._plain.busy

    def receive(self, frame: bytes) -> list[bytes]:
        """Responses to one request."""
        if len(frame) != FRAME_BYTES:
            return []
        if self._block is None and frame[0] >> 5 not in {_UP, _DOWN}:
            answer = self._plain.receive(frame)
            return [] if answer is None else [answer]
        index, sub = (self._block.index, self._block.sub) if self._block else (0, 0)
        try:
            if self._block is None or frame[0] == _ABORT or not self._block.belongs(frame):
                return self._begin(frame)
            answers = self._block.receive(frame)
            if self._block.done:
                self._block = None
            return answers
        except SdoError as abort:
            self.reset()
            return [SdoError(abort.code, index or abort.index, sub or abort.sub).encode()]

    def expire(self) -> bytes | None:
        """Abort the transfer in progress for want of a request."""
        if self._block is None:
            return self._plain.expire()
        abort = SdoError(Abort.TIMEOUT, self._block.index, self._block.sub)
        self.reset()
        return abort.encode()

    def reset(self) -> None:
        """Forget the transfer in progress without a word."""
        self._plain.reset()
        self._block = None

    def _begin(self, frame: bytes) -> list[bytes]:
        """A request of another transfer ends the one in progress, whatever its state."""
        self.reset()
        specifier, (_, index, sub, _) = frame[0] >> 5, _HEAD.unpack(frame)
        try:
            if specifier == _DOWN and not frame[0] & 1:
                download = _ServedDownload(self._objects, frame)
                self._block = download
                return [download.answer()]
            if specifier == _UP and not frame[0] & 3:
                data = self._objects.read(index, sub)
                if len(data) <= frame[5]:  # the client would rather have it in the ordinary way
                    answer = self._plain.receive(Upload(index, sub).request())
                    return [] if answer is None else [answer]
                upload = _ServedUpload(frame, data)
                self._block = upload
                return [upload.answer()]
            if specifier in {_UP, _DOWN}:
                raise SdoError(Abort.COMMAND)
        except SdoError as abort:
            own = abort.code == Abort.COMMAND
            raise SdoError(abort.code, 0 if own else index, 0 if own else sub) from None
        answer = self._plain.receive(frame)
        return [] if answer is None else [answer]


class _BlockClient:
    """What both kinds of client transfer share.

    Attributes:
        index, sub: The object.
        done: Whether the transfer has succeeded.
    """

    def __init__(self, index: int, sub: int) -> None:
        self.index = index
        self.sub = sub
        self.done = False

    def expire(self) -> SdoError:
        """The error of a server that does not answer; `encode()` of it tells the server."""
        return self._fail(Abort.TIMEOUT)

    def _fail(self, code: int, *, received: bool = False) -> SdoError:
        return SdoError(code, self.index, self.sub, received=received)

    def _check_abort(self, frame: bytes) -> None:
        if frame[0] == _ABORT:
            raise self._fail(_HEAD.unpack(frame)[3], received=True)


class BlockDownload(_BlockClient):
    """Write one object: send `request()`, then all that `receive` returns, until `done`."""

    def __init__(self, index: int, sub: int, data: bytes) -> None:
        super().__init__(index, sub)
        self._sender = _Sender(data)
        self._next = 0  # lowest two bits of the server's next message
        self._with_crc = False

    def request(self) -> bytes:
        return _HEAD.pack(0xC6, self.index, self.sub, len(self._sender.data))

    def receive(self, frame: bytes) -> list[bytes]:
        """Next messages; none when there is nothing to say.

        Raises:
            SdoError: The server aborted, or answered wrongly.
        """
        if len(frame) != FRAME_BYTES or self.done:
            return []
        self._check_abort(frame)
        if frame[0] >> 5 != _UP or frame[0] & 3 != self._next:
            raise self._fail(Abort.COMMAND)
        try:
            if self._next == 1:
                self.done = True
                return []
            if self._next == 0:
                self._with_crc = bool(frame[0] & _WITH_CRC)
                self._next, size = 2, frame[4]
            else:
                self._sender.confirm(frame[1])
                size = frame[2]
            if self._sender.done:
                self._next = 1
                return [self._sender.end(_DOWN, with_crc=self._with_crc)]
            return self._sender.block(size)
        except SdoError as error:
            raise self._fail(error.code) from None


class BlockUpload(_BlockClient):
    """Read one object: send `request()`, then all that `receive` returns, until `done`.

    Attributes:
        data: The value's bytes.
    """

    def __init__(self, index: int, sub: int = 0) -> None:
        super().__init__(index, sub)
        self.data = b""
        self._plain: Upload | None = None  # where the server prefers an ordinary transfer
        self._receiver: _Receiver | None = None
        self._size: int | None = None
        self._with_crc = False

    def request(self) -> bytes:
        return _HEAD.pack(0xA4, self.index, self.sub, MOST_SEGMENTS)

    def receive(self, frame: bytes) -> list[bytes]:
        """Next messages; none when there is nothing to say.

        Raises:
            SdoError: The server aborted, or answered wrongly.
        """
        if len(frame) != FRAME_BYTES or self.done:
            return []
        self._check_abort(frame)
        try:
            if self._receiver is None:
                return self._begin(frame)
            if not self._receiver.complete:
                number = self._receiver.take(frame)
                return [] if number is None else [bytes((0xA2, number, MOST_SEGMENTS)).ljust(FRAME_BYTES, b"\0")]
            if frame[0] >> 5 != _DOWN or not frame[0] & 1:
                raise SdoError(Abort.COMMAND)
            self.data = self._receiver.data(frame, with_crc=self._with_crc)
            if self._size is not None and len(self.data) != self._size:
                raise SdoError(Abort.LENGTH)
        except SdoError as error:
            raise self._fail(error.code, received=error.received) from None
        self.done = True
        return [b"\xa1".ljust(FRAME_BYTES, b"\0")]

    def _begin(self, frame: bytes) -> list[bytes]:
        command, _, _, size = _HEAD.unpack(frame)
        if self._plain is None and command >> 5 != _DOWN:
            self._plain = Upload(self.index, self.sub)
        if self._plain is not None:
            request = self._plain.receive(frame)
            self.done, self.data = self._plain.done, self._plain.data
            return [] if request is None else [request]
        self._with_crc = bool(command & _WITH_CRC)
        self._size = size if command & _WITH_SIZE else None
        self._receiver = _Receiver(2**32 if self._size is None else self._size)
        return [b"\xa3".ljust(FRAME_BYTES, b"\0")]
