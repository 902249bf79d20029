"""What an MCAP file contains, read without trusting it.

The library's readers do not check chunk CRCs unless told to, say "record length limit exceeded" of a truncated file,
and decompress whatever a chunk announces. Here every length is checked against what there is, every chunk against
its announced size and CRC, and the data section against its own. Record contents are parsed by the library's records.
"""

import struct
import zlib
from collections.abc import Collection, Iterator
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
MAX_SIGNAL_BYTES = 4 << 30  # of one topic; ten hours of six drives at 1 kHz
_HEAD = struct.Struct("<BQ")
_INDEX_HEAD = struct.Struct("<HI")
_INDEX_ENTRY_BYTES = 16
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
    """A chunk and, where it is indexed, the number of its messages by channel id."""

    span: Span
    counts: dict[int, int] = field(default_factory=dict)


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
    contents: Contents | None = None
    footer: Span | None = None
    ended = False
    for span in walk(buffer, len(MAGIC), end):
        if span.opcode == Opcode.HEADER and contents is None:
            contents = Contents(buffer, parse(Header, buffer, span))
        elif contents is None:
            raise BrokenFileError(span.begin, "does not start with a header")
        elif span.opcode == Opcode.DATA_END:
            crc = parse(DataEnd, buffer, span).data_section_crc
            if crc not in (0, zlib.crc32(buffer[: span.begin])):
                raise BrokenFileError(span.begin, "has a wrong checksum over its data")
            ended = True
        elif span.opcode == Opcode.FOOTER:
            footer = span
        elif not ended:
            _note(contents, span)
    if contents is None or footer is None or not ended:
        raise BrokenFileError(end, "ends before its recording was complete", truncated=True)
    _check_summary(buffer, footer)
    return contents


def _note(contents: Contents, span: Span) -> None:
    """File a record of the data section."""
    buffer = contents.buffer
    match span.opcode:
        case Opcode.CHUNK:
            contents.chunks.append(ChunkSpan(span))
        case Opcode.MESSAGE_INDEX if contents.chunks and span.end - span.start >= _INDEX_HEAD.size:
            channel, length = _INDEX_HEAD.unpack_from(buffer, span.start)
            contents.chunks[-1].counts[channel] = length // _INDEX_ENTRY_BYTES
        case Opcode.MESSAGE:
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


def _check_summary(buffer: Buffer, span: Span) -> None:
    footer = parse(Footer, buffer, span)
    start = footer.summary_start or span.begin
    if not len(MAGIC) < start <= span.begin:
        raise BrokenFileError(span.begin, "has a footer that points outside of the file")
    crc = zlib.crc32(buffer[start : span.end - 4])  # the summary and the footer up to its own CRC
    if footer.summary_crc not in (0, crc):
        raise BrokenFileError(start, "has a wrong checksum over its summary")


@dataclass(slots=True)
class Messages:
    """Messages of one channel.

    Attributes:
        blocks: Runs of messages of equal size, in file order, each of shape (n, size).
        log_time: shape (N,) over all blocks [ns].
    """

    blocks: list[NDArray[np.uint8]] = field(default_factory=list)
    log_time: list[int] = field(default_factory=list)


def messages(contents: Contents, topics: Collection[str]) -> dict[str, Messages]:
    """Messages of some topics; chunks that an index says have none of them stay closed.

    Raises:
        BrokenFileError: A chunk is damaged, or there is more than `MAX_SIGNAL_BYTES`.
    """
    found: dict[str, Messages] = {topic: Messages() for topic in topics}
    total = 0
    for chunk in contents.chunks:
        known = [contents.channels[i].topic for i in chunk.counts if i in contents.channels]
        if len(known) == len(chunk.counts) > 0 and found.keys().isdisjoint(known):
            continue
        _, data = open_chunk(contents.buffer, chunk.span)
        spans = []
        for span in walk(data, 0, len(data)):
            if span.opcode == Opcode.MESSAGE:
                spans.append(span)
            else:
                note_channel(contents, data, span)
        total += _gather(contents, data, spans, found)
        if total > MAX_SIGNAL_BYTES:
            raise BrokenFileError(chunk.span.begin, f"has more than {MAX_SIGNAL_BYTES >> 30} GiB of signals")
    _gather(contents, contents.buffer, contents.loose, found)
    return found


def _gather(contents: Contents, data: Buffer, spans: list[Span], found: dict[str, Messages]) -> int:
    """Sort messages to their topics; returns the bytes kept."""
    starts: dict[int, list[tuple[int, int]]] = {}
    for span in spans:
        if span.end - span.start < MESSAGE.size:
            raise BrokenFileError(span.begin, "has a message shorter than its head")
        channel, _sequence, log_time, _publish_time = MESSAGE.unpack_from(data, span.start)
        if channel not in contents.channels:
            raise BrokenFileError(span.begin, f"has a message of the unknown channel {channel}")
        topic = found.get(contents.channels[channel].topic)
        if topic is not None:
            topic.log_time.append(log_time)
            starts.setdefault(channel, []).append((span.start + MESSAGE.size, span.end))
    raw = np.frombuffer(data, dtype=np.uint8)
    kept = 0
    for channel, places in starts.items():
        begin, end = np.array(places).T
        size = end - begin
        for run in np.split(np.arange(len(size)), np.flatnonzero(np.diff(size)) + 1):
            block = raw[begin[run][:, None] + np.arange(size[run[0]])]
            found[contents.channels[channel].topic].blocks.append(block)
            kept += block.nbytes
    return kept
