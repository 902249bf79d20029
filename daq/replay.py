"""Raw frames of a recording, back in the order of their arrival on all buses."""

from collections.abc import Iterator
from itertools import groupby
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from protocols import topics
from protocols.cdr import Block
from protocols.frames import ERROR, EXTENDED, ID_MASK, REMOTE, Frame

Batch = tuple[str, list[tuple[int, Frame]]]
_WINDOW_NS = 2_000_000_000  # the recorder writes each bus in blocks of a fraction of a second


def bus_of(topic: str) -> str | None:
    """Bus of a topic `/BUS/frames`; None for other topics."""
    bus = topic.removeprefix("/").removesuffix("/frames")
    return bus if topics.FRAMES.format(bus=bus) == topic else None


def to_frames(data: NDArray[np.uint8], log_time: NDArray[np.uint64]) -> list[tuple[int, Frame]]:
    """Pairs (arrival, frame) of `can_msgs/msg/Frame` messages.

    Args:
        data: One message a row, shape (n, size).
        log_time: shape (n,) [ns].

    Raises:
        ValueError: The messages are not of one shape.
    """
    rows = Block(topics.FRAME, data[0].tobytes()).view(data)
    can_id = rows["id"] & ID_MASK
    can_id |= np.where(rows["is_extended"], EXTENDED, 0).astype(np.uint32)
    can_id |= np.where(rows["is_error"], ERROR, 0).astype(np.uint32)
    can_id |= np.where(rows["is_rtr"], REMOTE, 0).astype(np.uint32)
    payload = rows["data"].tobytes()
    fields = zip(log_time.tolist(), can_id.tolist(), rows["dlc"].tolist(), strict=True)
    return [
        (t_ns, Frame(ident, b"", dlc) if ident & REMOTE else Frame(ident, payload[8 * i : 8 * i + dlc]))
        for i, (t_ns, ident, dlc) in enumerate(fields)
    ]


class Merge:
    """Blocks of single buses in, short batches of all buses in order out; holds two seconds of frames."""

    def __init__(self) -> None:
        self._waiting: list[tuple[int, str, Frame]] = []
        self._newest_ns = 0

    def add(self, bus: str, frames: list[tuple[int, Frame]]) -> Iterator[Batch]:
        """Take a block; yields what no later block can precede."""
        self._waiting += [(t_ns, bus, frame) for t_ns, frame in frames]
        self._newest_ns = max(self._newest_ns, frames[-1][0] if frames else 0)
        if self._waiting and self._newest_ns - self._waiting[0][0] > 2 * _WINDOW_NS:
            yield from self._release(self._newest_ns - _WINDOW_NS)

    def rest(self) -> Iterator[Batch]:
        """What is left at the end."""
        yield from self._release(self._newest_ns)

    def _release(self, until_ns: int) -> Iterator[Batch]:
        self._waiting.sort(key=itemgetter(0))  # stable: the order on each bus stays
        count = sum(t_ns <= until_ns for t_ns, _, _ in self._waiting)
        released, self._waiting = self._waiting[:count], self._waiting[count:]
        for bus, run in groupby(released, key=itemgetter(1)):
            yield bus, [(t_ns, frame) for t_ns, _, frame in run]
