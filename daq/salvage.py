"""All that is sound in a damaged or truncated MCAP file.

A bad chunk costs that chunk only: the search for the next one starts right behind the place where the damage shows,
since a damaged length would lead anywhere.
"""

import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema

from protocols.container import (
    MAGIC,
    MESSAGE,
    BrokenFileError,
    Buffer,
    Span,
    open_chunk,
    parse,
    walk,
)

_CHUNK_HEAD = struct.Struct("<BQQQQI")  # opcode, length, first and last time, size, CRC; the compression's name follows
_MARKS = tuple(struct.pack("<I", len(name)) + name for name in (b"zstd", b"lz4"))


class Message(NamedTuple):
    """One message as it is in the file."""

    channel: int
    sequence: int
    log_time: int
    publish_time: int
    data: bytes


class Lost(NamedTuple):
    """A stretch of the file that could not be read.

    Attributes:
        begin, end: Bytes.
        reason: What is wrong with it.
        first_s, last_s: Time of the messages in it, where the chunk's head could still be read.
    """

    begin: int
    end: int
    reason: str
    first_s: float | None
    last_s: float | None


class Batch(NamedTuple):
    """Messages of one chunk."""

    messages: list[Message]


Found = Schema | Channel | Attachment | Metadata | Batch | Lost


class Salvage:
    """Iterates over what is sound, in file order.

    Attributes:
        complete: The data section's end was reached.
    """

    def __init__(self, buffer: Buffer) -> None:
        self.complete = False
        self._buffer = buffer

    def __iter__(self) -> Iterator[Found]:
        at, end = len(MAGIC), len(self._buffer)
        while at < end:
            try:
                for span in walk(self._buffer, at, end):
                    at = span.begin
                    if span.opcode == Opcode.DATA_END:
                        self.complete = True
                        return
                    yield from self._record(span)
                    at = span.end
            except BrokenFileError as error:
                resumed = self._next_chunk(at + 1)
                yield Lost(at, resumed, str(error), *self._times(at))
                at = resumed

    def _record(self, span: Span) -> Iterator[Found]:
        buffer = self._buffer
        match span.opcode:
            case Opcode.CHUNK:
                _, data = open_chunk(buffer, span)
                yield from _inside(data, span)
            case Opcode.SCHEMA:
                yield parse(Schema, buffer, span)
            case Opcode.CHANNEL:
                yield parse(Channel, buffer, span)
            case Opcode.METADATA:
                yield parse(Metadata, buffer, span)
            case Opcode.ATTACHMENT:
                stored = int.from_bytes(buffer[span.end - 4 : span.end], "little")
                if stored not in (0, zlib.crc32(buffer[span.start : span.end - 4])):
                    raise BrokenFileError(span.begin, "has an attachment with a wrong checksum")
                yield parse(Attachment, buffer, span)
            case Opcode.MESSAGE:
                yield Batch([_message(buffer, span)])
            case Opcode.HEADER | Opcode.MESSAGE_INDEX:
                pass
            case _:
                raise BrokenFileError(span.begin, f"has a record of type {span.opcode} among its data")

    def _next_chunk(self, start: int) -> int:
        """Where the next plausible chunk starts; the end of the file if there is none."""
        buffer = bytes(self._buffer[start:]) if start < len(self._buffer) else b""
        best = len(self._buffer)
        for mark in _MARKS:
            at = buffer.find(mark)
            while at >= 0:
                begin = at - _CHUNK_HEAD.size
                if begin >= 0:
                    opcode, length, *_ = _CHUNK_HEAD.unpack_from(buffer, begin)
                    if opcode == Opcode.CHUNK and begin + 9 + length <= len(buffer):
                        best = min(best, start + begin)
                        break
                at = buffer.find(mark, at + 1)
        return best

    def _times(self, begin: int) -> tuple[float | None, float | None]:
        if begin + _CHUNK_HEAD.size > len(self._buffer) or self._buffer[begin] != Opcode.CHUNK:
            return None, None
        _, _, first, last, _, _ = _CHUNK_HEAD.unpack_from(self._buffer, begin)
        return (first * 1e-9, last * 1e-9) if first <= last else (None, None)


def _inside(data: bytes, chunk: Span) -> Iterator[Found]:
    """Records of a chunk; its checksum has been verified, so any disorder is the writer's."""
    batch: list[Message] = []
    try:
        for span in walk(data, 0, len(data)):
            if span.opcode == Opcode.MESSAGE:
                batch.append(_message(data, span))
            elif span.opcode == Opcode.SCHEMA:
                yield parse(Schema, data, span)
            elif span.opcode == Opcode.CHANNEL:
                yield parse(Channel, data, span)
    except BrokenFileError as error:
        raise BrokenFileError(chunk.begin, f"has a chunk that {error} inside") from error
    yield Batch(batch)


def _message(buffer: Buffer, span: Span) -> Message:
    head = span.start + MESSAGE.size
    if head > span.end:
        raise BrokenFileError(span.begin, "has a message shorter than its head")
    channel, sequence, log_time, publish_time = MESSAGE.unpack_from(buffer, span.start)
    return Message(channel, sequence, log_time, publish_time, bytes(buffer[head : span.end]))
