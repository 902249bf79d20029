"""Messages of a scanned recording, many of equal size as one array."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from protocols.container import (
    MESSAGE,
    BrokenFileError,
    Buffer,
    ChunkSpan,
    Contents,
    Span,
    messages_in,
    open_chunk,
)

# A message record: opcode and length, then the head of `MESSAGE`.
_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("published", "<u8"),
    ]
)
_RECORD_BYTES = 9  # of opcode and length
MAX_SIGNAL_BYTES = 4 << 30  # of the topics read at once; ten hours of six drives at 1 kHz


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
    """Messages of some topics.

    Raises:
        BrokenFileError: A chunk is damaged, or there is more than `MAX_SIGNAL_BYTES`.
    """
    whole: dict[str, Messages] = {topic: Messages() for topic in topics}
    total = 0
    for found in messages_by_chunk(contents, topics):
        for topic, some in found.items():
            whole[topic].blocks += some.blocks
            whole[topic].log_time += some.log_time
            total += sum(block.nbytes for block in some.blocks)
        if total > MAX_SIGNAL_BYTES:
            raise BrokenFileError(len(contents.buffer), f"has more than {MAX_SIGNAL_BYTES >> 30} GiB of signals")
    return whole


def messages_by_chunk(contents: Contents, topics: Collection[str]) -> Iterator[dict[str, Messages]]:
    """Messages of some topics, chunk by chunk; chunks that an index says have none of them stay closed.

    Raises:
        BrokenFileError: A chunk is damaged.
    """
    for chunk in contents.chunks:
        known = [contents.channels[i].topic for i in chunk.log_time if i in contents.channels]
        if len(known) < len(chunk.log_time) or not known or not set(topics).isdisjoint(known):
            indexed = _indexed(contents, chunk, topics)
            yield _gather(contents, *messages_in(contents, chunk), topics) if indexed is None else indexed
    yield _gather(contents, contents.buffer, contents.loose, topics)


def arrivals(contents: Contents) -> dict[str, NDArray[np.uint64]]:
    """Arrival of all messages by topic, in file order [ns]; from the index where there is one.

    Raises:
        BrokenFileError: A chunk that had to be opened is damaged.
    """
    found: dict[int, list[NDArray[np.uint64]]] = {}
    for chunk in contents.chunks:
        times = chunk.log_time or _times(*messages_in(contents, chunk))
        for channel, log_time in times.items():
            found.setdefault(channel, []).append(log_time)
    for channel, log_time in _times(contents.buffer, contents.loose).items():
        found.setdefault(channel, []).append(log_time)
    none = [np.array([], dtype=np.uint64)]
    return {c.topic: np.concatenate(found.get(c.id, none)) for c in contents.channels.values()}


def _times(data: Buffer, spans: list[Span]) -> dict[int, NDArray[np.uint64]]:
    times: dict[int, list[int]] = {}
    for span in spans:
        channel, _sequence, log_time, _publish_time = MESSAGE.unpack_from(data, span.start)
        times.setdefault(channel, []).append(log_time)
    return {channel: np.array(log_time, dtype=np.uint64) for channel, log_time in times.items()}


def _indexed(contents: Contents, chunk: ChunkSpan, topics: Collection[str]) -> dict[str, Messages] | None:
    """Messages at the places the index names, a hundred times faster than record by record; None if it is not true.

    It is true if its records are messages of its channels that fill the chunk's data without gap or overlap.
    """
    if not chunk.offset or not set(chunk.offset) <= set(contents.channels):
        return None
    data = np.frombuffer(open_chunk(contents.buffer, chunk.span)[1], dtype=np.uint8)
    begin = np.concatenate(list(chunk.offset.values())).astype(np.int64)
    channel = np.repeat(list(chunk.offset), [len(o) for o in chunk.offset.values()])
    order = np.argsort(begin)
    begin, channel = begin[order], channel[order]
    if not begin.size or begin[0] != 0 or begin[-1] > data.size - _HEAD.itemsize:
        return None
    head = data[begin[:, None] + np.arange(_HEAD.itemsize)].view(_HEAD)[:, 0]
    end = begin + _RECORD_BYTES + head["length"].astype(np.int64)
    if (
        (head["opcode"] != Opcode.MESSAGE).any()
        or (head["channel"] != channel).any()
        or (head["length"] < MESSAGE.size).any()
        or (end[:-1] != begin[1:]).any()
        or end[-1] != data.size
    ):
        return None
    found: dict[str, Messages] = {}
    for number, described in contents.channels.items():
        rows = np.flatnonzero(channel == number)
        if described.topic not in topics or not rows.size:
            continue
        some = found.setdefault(described.topic, Messages())
        some.log_time += head["log_time"][rows].tolist()
        some.blocks += _blocks(data, begin[rows] + _HEAD.itemsize, end[rows])
    return found


def _blocks(data: NDArray[np.uint8], begin: NDArray[np.int64], end: NDArray[np.int64]) -> list[NDArray[np.uint8]]:
    """Bytes of messages, equal sizes together."""
    size = end - begin
    runs = np.split(np.arange(len(size)), np.flatnonzero(np.diff(size)) + 1)
    return [data[begin[run][:, None] + np.arange(size[run[0]])] for run in runs]


def _gather(contents: Contents, data: Buffer, spans: list[Span], topics: Collection[str]) -> dict[str, Messages]:
    """Sort messages to their topics, equal sizes together."""
    found: dict[str, Messages] = {}
    places: dict[str, list[tuple[int, int]]] = {}
    for span in spans:
        channel, _sequence, log_time, _publish_time = MESSAGE.unpack_from(data, span.start)
        if channel not in contents.channels:
            raise BrokenFileError(span.begin, f"has a message of the unknown channel {channel}")
        topic = contents.channels[channel].topic
        if topic in topics:
            found.setdefault(topic, Messages()).log_time.append(log_time)
            places.setdefault(topic, []).append((span.start + MESSAGE.size, span.end))
    raw = np.frombuffer(data, dtype=np.uint8)
    for topic, where in places.items():
        begin, end = np.array(where).T
        found[topic].blocks += _blocks(raw, begin, end)
    return found
