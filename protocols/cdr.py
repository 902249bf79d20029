"""ROS 2 message types and their CDR bytes (OMG DDS-RTPS 10.2, XCDR1), driven by the `ros2msg` text itself.

The text that goes into a recording as schema is the only definition: fields are flattened to dotted names
(`header.stamp.sec`), and encoder, decoder and block layout walk the same list. CDR aligns each primitive to its own
size, counted from the byte after the 4-byte encapsulation header.

Rare messages go one by one through `encode` and `decode`; cyclic ones, whose bytes all have one shape, through
`Block`, a numpy view of many messages at once.
"""

import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

ENCAPSULATION = bytes((0, 1, 0, 0))  # CDR, little endian, no options
_START = len(ENCAPSULATION)
_LITTLE = 1  # second byte of the encapsulation

_PRIMITIVES = {  # ROS 2 name: numpy and struct codes agree on these
    "bool": "?",
    "byte": "B",
    "char": "B",
    "uint8": "B",
    "int8": "b",
    "uint16": "H",
    "int16": "h",
    "uint32": "I",
    "int32": "i",
    "uint64": "Q",
    "int64": "q",
    "float32": "f",
    "float64": "d",
}
_NEXT_TYPE = re.compile(r"^=+\s*$\s*^MSG:\s*(\S+)\s*$", re.MULTILINE)
_FIELD = re.compile(r"^([A-Za-z]\w*(?:/\w+)*)(?:<=\d+)?(\[(?:<=)?(\d*)\])?\s+([A-Za-z]\w*)\s*(\S.*)?$")
_MAX_DEPTH = 8  # of nested types; the deepest common one has 4


@dataclass(frozen=True, slots=True)
class Field:
    """One flattened field.

    Attributes:
        name: Dotted path.
        code: struct code of a primitive, or "s" for a string.
        count: None for a single value, 0 for a sequence, n for an array of n.
    """

    name: str
    code: str
    count: int | None

    @property
    def size(self) -> int:
        return struct.calcsize(self.code) if self.code != "s" else 4  # a string starts with its u32 length


@dataclass(frozen=True, slots=True)
class MessageType:
    """A message type.

    Attributes:
        name: Full name, `sensor_msgs/msg/JointState`.
        text: The `ros2msg` definition with all nested ones.
        fields: In the order of the bytes.
    """

    name: str
    text: str
    fields: tuple[Field, ...]

    @classmethod
    def parse(cls, name: str, text: str) -> "MessageType":
        """Type of a definition.

        Raises:
            ValueError: A line is no field, a nested type is not defined, or a sequence of nested types (which none
                of our topics has).
        """
        first, *rest = _NEXT_TYPE.split(text)
        nested = {key.rpartition("/")[2]: body for key, body in zip(rest[::2], rest[1::2], strict=True)}
        return cls(name, text, tuple(_flatten(first, nested, "", 0)))

    def encode(self, values: Mapping[str, Any]) -> bytes:
        """Bytes of a message.

        Args:
            values: By dotted name; every field is needed.
        """
        out = bytearray()
        for field in self.fields:
            value = values[field.name]
            if field.count is None:
                _put(out, field, (value,))
            else:
                if field.count == 0:
                    _align(out, 4)
                    out += struct.pack("<I", len(value))
                elif len(value) != field.count:
                    raise ValueError(f"{self.name}: {field.name} needs {field.count} values, not {len(value)}")
                _put(out, field, value)
        return ENCAPSULATION + bytes(out)

    def decode(self, data: bytes) -> dict[str, Any]:
        """Values of a message by dotted name; sequences are lists.

        Raises:
            ValueError: The bytes end early, or announce more than there is.
        """
        order = _order(data)
        values: dict[str, Any] = {field.name: [] for field in self.fields if field.count is not None}
        for field, start, count in self.spans(data):
            if field.code == "s":
                value: list[Any] = [data[start + 4 : start + 3 + _u32(data, order, start)].decode(errors="replace")]
            else:
                value = list(struct.unpack_from(f"{order}{count}{field.code}", data, start))
            if field.count is None:
                values[field.name] = value[0]
            else:
                values[field.name] += value
        return values

    def spans(self, data: bytes) -> Iterator[tuple[Field, int, int]]:
        """Where the values are: field, offset of its first value, number of values; strings one by one.

        Raises:
            ValueError: As `decode`.
        """
        order, at = _order(data), _START
        for field in self.fields:
            count = 1 if field.count is None else field.count
            if field.count == 0:
                at += -(at - _START) % 4
                count, at = _u32(data, order, at), at + 4
            if field.code == "s":
                for _ in range(count):
                    at += -(at - _START) % 4
                    start, at = at, at + 4 + _u32(data, order, at)
                    self._check(data, at)
                    yield field, start, 1
            elif count:
                at += -(at - _START) % field.size
                start, at = at, at + count * field.size
                self._check(data, at)
                yield field, start, count

    def _check(self, data: bytes, end: int) -> None:
        if end > len(data):
            raise ValueError(f"{self.name}: the message needs {end} bytes or more, but has {len(data)}")


class Block:
    """Many messages that differ in their numbers only: same strings, same sequence lengths.

    Attributes:
        dtype: Structured type of one message, a field per dotted name (shape (n,) where there are n values).
    """

    def __init__(self, kind: MessageType, template: bytes) -> None:
        """Shape of one message.

        Args:
            template: Bytes of any message of that shape.
        """
        order = _order(template)
        names, formats, offsets = [], [], []
        constant = np.ones(len(template), dtype=bool)
        for field, start, count in kind.spans(template):
            if field.code == "s":
                continue
            names.append(field.name)
            code = np.dtype(order + field.code)
            formats.append(code if field.count is None else (code, (count,)))
            offsets.append(start)
            constant[start : start + count * field.size] = False
        self.dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": len(template)})
        self._template = template
        self._constant = np.flatnonzero(constant)

    def rows(self, count: int) -> NDArray[np.void]:
        """Writable messages, shape (count,), whose numbers are still those of the template."""
        return np.frombuffer(bytearray(self._template * count), dtype=self.dtype)

    def view(self, data: NDArray[np.uint8]) -> NDArray[np.void]:
        """Messages of bytes.

        Args:
            data: One message a row, shape (count, itemsize).

        Raises:
            ValueError: A message has other strings or other lengths than the template.
        """
        template = np.frombuffer(self._template, dtype=np.uint8)
        same = (data[:, self._constant] == template[self._constant]).all(axis=1)
        if not same.all():
            raise ValueError(f"message {int(np.argmin(same))} has other names or lengths than the first")
        return np.ascontiguousarray(data).view(self.dtype)[:, 0]


def _flatten(text: str, nested: Mapping[str, str], prefix: str, depth: int) -> Iterator[Field]:
    if depth > _MAX_DEPTH:
        raise ValueError(f"{prefix}: types are nested more than {_MAX_DEPTH} deep")
    for raw in text.splitlines():
        line = raw.partition("#")[0].strip()
        match = _FIELD.match(line)
        if not line or (match is not None and match[5] is not None and match[5].startswith("=")):
            continue  # blank, or a constant
        if match is None:
            raise ValueError(f"{line!r} is not a message field")
        kind, array, length, name, _default = match.groups()
        count = int(length) if array and length and "<=" not in array else 0 if array else None
        if kind in _PRIMITIVES:
            yield Field(prefix + name, _PRIMITIVES[kind], count)
        elif kind == "string":
            yield Field(prefix + name, "s", count)
        else:
            short = kind.rpartition("/")[2]
            if short not in nested or count is not None:
                raise ValueError(f"{prefix}{name}: type {kind}{array or ''} is not supported")
            yield from _flatten(nested[short], nested, f"{prefix}{name}.", depth + 1)


def _align(out: bytearray, size: int) -> None:
    out += bytes(-len(out) % size)


def _put(out: bytearray, field: Field, values: Any) -> None:
    if field.code == "s":
        for text in values:
            raw = text.encode() + b"\0"
            _align(out, 4)
            out += struct.pack("<I", len(raw)) + raw
    elif len(values):
        _align(out, field.size)
        out += struct.pack(f"<{len(values)}{field.code}", *values)


def _order(data: bytes) -> str:
    if len(data) < _START:
        raise ValueError(f"a CDR message has 4 bytes or more, not {len(data)}")
    return "<" if data[1] & _LITTLE else ">"


def _u32(data: bytes, order: str, at: int) -> int:
    if at + 4 > len(data):
        raise ValueError(f"the message ends at byte {len(data)}, inside a length")
    value: int = struct.unpack_from(f"{order}I", data, at)[0]
    return value
