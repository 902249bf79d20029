"""CDR bytes against `rosbags`, an independent implementation, for all topics and for awkward alignments."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from protocols import topics
from protocols.cdr import Block, MessageType

AWKWARD = MessageType.parse(
    "test_msgs/msg/Awkward",
    """# every alignment after every other
bool flag
string name
float64[] wide
uint8 small
int16[3] fixed
string[] names
uint64 big
float32[] narrow
string[2] two
std_msgs/Header header
int8[] last

================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
""",
)
KINDS = [topic.type for topic in topics.TOPICS] + [AWKWARD]
_RANGES = {"b": 7, "h": 15, "i": 31, "q": 63}


@pytest.fixture(scope="module")
def store():
    store = get_typestore(Stores.ROS2_HUMBLE)
    for kind in KINDS:
        if kind.name not in store.types:
            store.register(get_types_from_msg(kind.text, kind.name))
    return store


def values(kind: MessageType) -> st.SearchStrategy[dict[str, object]]:
    def one(code: str) -> st.SearchStrategy[object]:
        if code == "s":
            return st.text("aßZ 日", max_size=9)
        if code == "?":
            return st.booleans()
        if code in "fd":
            return st.floats(width=32 if code == "f" else 64, allow_nan=False)
        if code in _RANGES:
            return st.integers(-(1 << _RANGES[code]), (1 << _RANGES[code]) - 1)
        return st.integers(0, (1 << 8 * np.dtype(code).itemsize) - 1)

    def field(f: object) -> st.SearchStrategy[object]:
        if f.count is None:
            return one(f.code)
        return st.lists(one(f.code), min_size=f.count, max_size=f.count or 7)

    return st.fixed_dictionaries({f.name: field(f) for f in kind.fields})


def attribute(message: object, path: str) -> object:
    for name in path.split("."):
        message = getattr(message, name)
    return message.tolist() if isinstance(message, np.ndarray) else message


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.name)
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_both_ways(store, kind, data):
    wanted = data.draw(values(kind))
    encoded = kind.encode(wanted)
    theirs = store.deserialize_cdr(encoded, kind.name)
    assert {name: attribute(theirs, name) for name in wanted} == wanted
    assert bytes(store.serialize_cdr(theirs, kind.name)) == encoded
    assert kind.decode(encoded) == wanted
    assert kind.decode(bytes(store.serialize_cdr(theirs, kind.name, little_endian=False))) == wanted


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.name)
@settings(max_examples=20, deadline=None)
@given(data=st.data())
def test_a_block_reads_and_writes_what_the_codec_does(kind, data):
    wanted = data.draw(values(kind))
    encoded = kind.encode(wanted)
    block = Block(kind, encoded)
    [row] = block.view(np.frombuffer(encoded * 1, dtype=np.uint8).reshape(1, -1))
    rows = block.rows(3)
    for name in block.dtype.names or ():
        assert np.array_equal(row[name], wanted[name])
        rows[name] = row[name]
    assert rows.tobytes() == encoded * 3


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=120))
def test_garbage_is_refused_or_read_but_never_trusted(garbage):
    for kind in KINDS:
        try:
            kind.decode(garbage)
        except ValueError as error:
            assert str(error)
        except UnicodeDecodeError:
            pytest.fail("text must be replaced, not refused")


def test_a_length_beyond_the_message_is_refused():
    encoded = bytearray(topics.JOINT_STATE.encode({
        **topics.stamp(0), "header.frame_id": "", "name": ["a"], "position": [1.0], "velocity": [], "effort": [2.0],
    }))  # fmt: skip
    encoded[4 + 16 : 4 + 20] = b"\xff\xff\xff\x7f"
    with pytest.raises(ValueError, match="the message needs|inside a length"):
        topics.JOINT_STATE.decode(bytes(encoded))


def test_what_is_not_supported_says_so():
    with pytest.raises(ValueError, match=r"type geometry_msgs/Point\[\] is not supported"):
        MessageType.parse("x/msg/Y", "geometry_msgs/Point[] points")
    with pytest.raises(ValueError, match="'int32 = x' is not a message field"):
        MessageType.parse("x/msg/Y", "int32 = x")
    with pytest.raises(ValueError, match="nested more than 8 deep"):
        MessageType.parse("x/msg/Y", "A a\n=====\nMSG: x/A\nA a\n")
    rest = {"stamp.sec": 0, "stamp.nanosec": 0, "level": 20, "msg": "c", "file": "", "function": "", "line": 0}
    block = Block(topics.EVENT, topics.EVENT.encode({"name": "ab", **rest}))
    other = topics.EVENT.encode({"name": "xy", **rest})
    with pytest.raises(ValueError, match="message 0 has other names or lengths than the first"):
        block.view(np.frombuffer(other, dtype=np.uint8).reshape(1, -1))
