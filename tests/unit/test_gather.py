"""Messages found by their index are those that a walk over every record finds; a wrong index is not believed."""

from collections.abc import Callable

import numpy as np
import pytest

from ident.dataset import Signals
from protocols import topics
from protocols.container import Contents, scan
from protocols.gather import messages
from protocols.robot import Robot

WANTED = [topics.CYCLE, topics.JOINTS]


@pytest.fixture(scope="module")
def file(tx40: Robot, make_signals: Callable[..., Signals], make_recording: Callable[..., bytes]) -> bytes:
    return make_recording(tx40, make_signals(tx40, 51, 2.0))


def read(contents: Contents) -> dict[str, tuple[np.ndarray, list[int]]]:
    found = messages(contents, WANTED)
    return {topic: (np.concatenate(m.blocks), m.log_time) for topic, m in found.items()}


def same(a: Contents, b: Contents) -> bool:
    x, y = read(a), read(b)
    return all(np.array_equal(x[t][0], y[t][0]) and x[t][1] == y[t][1] for t in WANTED)


def test_the_index_gives_what_a_walk_gives(file: bytes) -> None:
    indexed, walked = scan(file), scan(file)
    assert all(chunk.offset for chunk in indexed.chunks)
    for chunk in walked.chunks:
        chunk.offset.clear()
    assert same(indexed, walked)
    assert len(read(indexed)[topics.CYCLE][1]) == 2000


@pytest.mark.parametrize("damage", ["beyond", "shifted", "other channel", "short", "twice"])
def test_an_index_that_lies_is_not_believed(file: bytes, damage: str) -> None:
    contents = scan(file)
    channels = sorted(contents.channels)
    for chunk in contents.chunks:
        for channel, offset in list(chunk.offset.items()):
            if damage == "beyond":
                chunk.offset[channel] = offset + np.uint64(2**62)
            elif damage == "shifted":
                chunk.offset[channel] = offset + np.uint64(1)
            elif damage == "other channel":
                del chunk.offset[channel]
                chunk.offset[channels[channels.index(channel) - 1]] = offset
            elif damage == "short":
                chunk.offset[channel] = offset[:-1]
            else:
                chunk.offset[channel] = np.append(offset, offset[-1])
    assert same(contents, scan(file))
