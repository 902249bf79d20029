"""What an MCAP file contains, read without trusting it.

The library's readers do not check chunk CRCs unless told to, say "record length limit exceeded" of a truncated file,
and decompress whatever a chunk announces. Here every length is checked against what there is, every chunk against
its announced size and CRC, and the data section against its own. Record contents are parsed by the library's records.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import NamedTuple, TypeVar

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, Header, McapRecord, Metadata, Schema
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

MAGIC = MCAP0_MAGIC
MAX_CHUNK_BYTES = 64 << 20  # decompressed; ours have 256 KiB, the largest seen elsewhere 4 MiB
_HEAD = struct.Struct("<BQ")
_INDEX_HEAD = struct.Struct("<HI")
_INDEX_ENTRY = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; then the data

Buffer = bytes | memoryview
R = TypeVar("R", bound=McapRecord)


class BrokenFileError(ValueError):
    """The bytes are not what the format promises.

    Attributes:
        offset: Where in the file.
        truncated: The file just ends there.
    """

    def __init__(self, offset: int, what: str, *, truncated: bool = False) -> None:
        super().__init__(what)
        self.offset = offset
        self.truncated = truncated


class Span(NamedTuple):
    """Where a record is: its opcode, where the record starts, where its content starts and ends."""

    opcode: int
    begin: int
    start: int
    end: int


@dataclass(slots=True)
class ChunkSpan:
    """A chunk and, where it is indexed, its messages by channel id.

    Attributes:
        log_time: Arrival [ns].
        offset: Where their records begin in the chunk's own data, as the index claims.
    """

    span: Span
    log_time: dict[int, NDArray[np.uint64]] = field(default_factory=dict)
    offset: dict[int, NDArray[np.uint64]] = field(default_factory=dict)


@dataclass(slots=True)
class Contents:
    """An intact file, its messages not yet read.

    Attributes:
        loose: Messages outside of chunks.
    """

    buffer: Buffer
    header: Header
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    chunks: list[ChunkSpan] = field(default_factory=list)
    loose: list[Span] = field(default_factory=list)


def walk(buffer: Buffer, start: int, end: int) -> Iterator[Span]:
    """Records one after the other.

    Raises:
        BrokenFileError: A record reaches beyond `end`, or its opcode is none.
    """
    while start < end:
        if start + _HEAD.size > end:
            raise BrokenFileError(start, "ends inside the head of a record", truncated=True)
        opcode, length = _HEAD.unpack_from(buffer, start)
        content = start + _HEAD.size
        if opcode == 0:
            raise BrokenFileError(start, "has a record of type 0, which does not exist")
        if content + length > end:
            raise BrokenFileError(start, f"ends inside a record of {length} bytes", truncated=True)
        yield Span(opcode, start, content, content + length)
        start = content + length


def parse(kind: type[R], buffer: Buffer, span: Span) -> R:
    """Content of a record.

    Raises:
        BrokenFileError: It is not of that kind.
    """
    stream = ReadDataStream(BytesIO(bytes(buffer[span.start : span.end])))
    try:
        record: R = kind.read(stream)  # type: ignore[attr-defined]  # every record but Message has it
    except (McapError, struct.error, UnicodeDecodeError) as error:
        raise BrokenFileError(span.begin, f"has an unreadable {kind.__name__} record") from error
    return record


def open_chunk(buffer: Buffer, span: Span) -> tuple[Chunk, bytes]:
    """A chunk and its decompressed records, sizes and CRC checked.

    Raises:
        BrokenFileError: See above.
    """
    chunk = parse(Chunk, buffer, span)
    size = chunk.uncompressed_size
    if size > MAX_CHUNK_BYTES:
        raise BrokenFileError(
            span.begin, f"has a chunk of {size} bytes decompressed, more than the {MAX_CHUNK_BYTES} allowed"
        )
    try:
        if chunk.compression == "zstd":
            announced = zstandard.frame_content_size(chunk.data)
            if announced not in (size, -1):
                raise BrokenFileError(span.begin, f"has a chunk of {size} bytes whose zstd frame announces {announced}")
            data = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
        elif chunk.compression == "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        elif chunk.compression == "":
            data = chunk.data
        else:
            raise BrokenFileError(
                span.begin, f"has a chunk compressed with {chunk.compression!r}; zstd, lz4 or none are read"
            )
    except (zstandard.ZstdError, RuntimeError) as error:  # lz4 raises RuntimeError
        raise BrokenFileError(span.begin, "has a chunk that cannot be decompressed") from error
    if len(data) != size:
        raise BrokenFileError(span.begin, f"has a chunk of {len(data)} bytes that should be {size}")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise BrokenFileError(span.begin, "has a chunk with a wrong checksum")
    return chunk, data


def scan(buffer: Buffer) -> Contents:
    """Everything but the messages.

    Raises:
        BrokenFileError: Not MCAP, truncated or damaged. Chunks are checked only by the data section's CRC here,
            where the file has one.
    """
    if bytes(buffer[: len(MAGIC)]) != MAGIC:
        raise BrokenFileError(0, "is not an MCAP file")
    end = len(buffer) - len(MAGIC)
    if end <= len(MAGIC) or bytes(buffer[end:]) != MAGIC:
        raise BrokenFileError(len(buffer), "ends before its recording was complete", truncated=True)
    spans = walk(buffer, len(MAGIC), end)
    first = next(spans)
    if first.opcode != Opcode.HEADER:
        raise BrokenFileError(first.begin, "does not start with a header")
    contents = Contents(buffer, parse(Header, buffer, first))
    for span in spans:
        if span.opcode == Opcode.DATA_END:
            crc = parse(DataEnd, buffer, span).data_section_crc
            if crc not in (0, zlib.crc32(buffer[: span.begin])):
                raise BrokenFileError(span.begin, "has a wrong checksum over its data")
            _read_summary(contents, spans)
            return contents
        _note(contents, span)
    raise BrokenFileError(end, "ends before its recording was complete", truncated=True)


def _read_summary(contents: Contents, spans: Iterator[Span]) -> None:
    """The summary repeats the schemas and channels that foreign files have inside of chunks."""
    buffer, footer = contents.buffer, None
    for span in spans:
        note_channel(contents, buffer, span)
        if span.opcode == Opcode.FOOTER:
            footer = span
    if footer is None:
        raise BrokenFileError(len(buffer), "ends before its recording was complete", truncated=True)
    about = parse(Footer, buffer, footer)
    start = about.summary_start or footer.begin
    if not len(MAGIC) < start <= footer.begin:
        raise BrokenFileError(footer.begin, "has a footer that points outside of the file")
    crc = zlib.crc32(buffer[start : footer.end - 4])  # the summary and the footer up to its own CRC
    if about.summary_crc not in (0, crc):
        raise BrokenFileError(start, "has a wrong checksum over its summary")
    if not contents.channels:  # it need not repeat them
        for chunk in contents.chunks:
            messages_in(contents, chunk)


def _note(contents: Contents, span: Span) -> None:
    """File a record of the data section."""
    buffer = contents.buffer
    match span.opcode:
        case Opcode.CHUNK:
            contents.chunks.append(ChunkSpan(span))
        case Opcode.MESSAGE_INDEX if contents.chunks and span.end - span.start >= _INDEX_HEAD.size:
            channel, length = _INDEX_HEAD.unpack_from(buffer, span.start)
            if length > span.end - span.start - _INDEX_HEAD.size or length % _INDEX_ENTRY.itemsize:
                raise BrokenFileError(span.begin, f"has a message index of {length} bytes in a shorter record")
            entries = np.frombuffer(
                buffer, _INDEX_ENTRY, length // _INDEX_ENTRY.itemsize, span.start + _INDEX_HEAD.size
            )
            contents.chunks[-1].log_time[channel] = entries["log_time"]
            contents.chunks[-1].offset[channel] = entries["offset"]
        case Opcode.MESSAGE if span.end - span.start >= MESSAGE.size:
            contents.loose.append(span)
        case Opcode.ATTACHMENT:
            attachment = parse(Attachment, buffer, span)
            contents.attachments[attachment.name] = attachment.data
        case Opcode.METADATA:
            metadata = parse(Metadata, buffer, span)
            contents.metadata[metadata.name] = metadata.metadata
        case _:
            note_channel(contents, buffer, span)


def note_channel(contents: Contents, buffer: Buffer, span: Span) -> None:
    """File a schema or channel record, which may stand inside of chunks too; others are passed over."""
    if span.opcode == Opcode.SCHEMA:
        schema = parse(Schema, buffer, span)
        contents.schemas[schema.id] = schema
    elif span.opcode == Opcode.CHANNEL:
        channel = parse(Channel, buffer, span)
        contents.channels[channel.id] = channel


def messages_in(contents: Contents, chunk: ChunkSpan) -> tuple[bytes, list[Span]]:
    """Records of a chunk and where its messages are; its schemas and channels are noted."""
    _, data = open_chunk(contents.buffer, chunk.span)
    spans = []
    for span in walk(data, 0, len(data)):
        if span.opcode != Opcode.MESSAGE:
            note_channel(contents, data, span)
        elif span.end - span.start < MESSAGE.size:
            raise BrokenFileError(chunk.span.begin, "has a message shorter than its head")
        else:
            spans.append(span)
    return data, spans
