"""What passes between `armrig request`, `armrig serve` and the log server over Zenoh.

Every payload is an *envelope*: one line of JSON (its type is defined here), a newline, then raw bytes where the JSON
announces them. Binary stays binary, and the JSON line alone can be read with any Zenoh tool.

An identification is one query. The replies come on the queried key, in this order, and the last is always `Done`:

    Accepted, Progress ..., Chunk ..., Done(status="ok")
    Accepted, Progress ..., Failure, Done(status="failed")      (a refused request has no Accepted)

Zenoh ends a query without replies and without error in many cases (no queryable, handler died, router gone, access
denied): a missing `Done` is therefore the one sign of failure that needs no guessing.
"""

import hashlib
import re
from collections.abc import Iterator
from typing import Annotated, Any, Literal, TypeVar, get_args

import msgspec
from msgspec import Meta

from protocols.errors import ArmrigError, ConfigError, DataError, IdentificationError, PeerError

PREFIX = "armrig"
CHUNK_BYTES = 1 << 20  # of a result; far below the transport's message limit
RANGE_BYTES = 4 << 20  # of a log per get: as fast as one reply, resumable, bounded memory (measured)
MAX_PAYLOAD_BYTES = 64 << 20  # recordings inside a request; larger ones go by log key
MAX_HEADER_BYTES = 4 << 20  # the JSON line
MAX_LOG_BYTES = 4 << 30  # the service fetches no larger log
ACCEPT_WITHIN_S = 0.1  # promise of the service
PEER_TIMEOUT_S = 3.0  # silence after which a client gives up on finding a service

T = TypeVar("T")
Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,127}$")]
_LOG_ID = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$"
LogId = Annotated[str, Meta(pattern=_LOG_ID)]  # an index entry, never a path
Sha256 = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$")]
Count = Annotated[int, Meta(ge=0)]

Method = Literal["ols", "wls", "iv", "didim", "cloe", "irls", "tls", "ml", "ekf", "setmembership"]
METHODS: tuple[Method, ...] = get_args(Method)
Part = Literal["result", "html", "model"]
Status = Literal["ok", "failed"]
ErrorCode = Literal[
    "bad-request", "too-large", "busy", "not-found", "peer", "configuration", "data", "not-identifiable", "bug"
]


class Message(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Base of every message."""


# --- keys ---


def identify_key(method: str) -> str:
    """Queryable of one method; `*` for all of them."""
    return f"{PREFIX}/identify/{method}"


def log_key(log_id: str) -> str:
    """A recording offered by the log server; `*` lists all. Without parameters the reply is `LogInfo`."""
    return f"{PREFIX}/log/{log_id}"


def is_log_id(text: str) -> bool:
    """Whether a log could have this id."""
    return re.fullmatch(_LOG_ID, text) is not None


def alive_key(service: str) -> str:
    """Liveliness token: `identify` and `log` are the services."""
    return f"{PREFIX}/alive/{service}"


# --- identification ---


class Attached(Message, frozen=True, tag="attached", tag_field="source"):
    """A recording (MCAP) whose bytes follow the JSON line, in the order of the request."""

    name: Name
    bytes: Count
    sha256: Sha256


class Logged(Message, frozen=True, tag="log", tag_field="source"):
    """A recording that the log server keeps."""

    log: LogId


class Options(Message, frozen=True):
    """Signal processing and model choices; where left out, the service's defaults.

    Attributes:
        filter_Hz: Cut-off of the zero-phase Butterworth filter on positions.
        decimate_to_Hz: Rate after parallel decimation.
        speed_threshold_rad_s: Rows slower than this are dropped per joint (the sign of friction is uncertain).
        offsets: Identify a constant torque per joint.
    """

    filter_Hz: Annotated[float, Meta(gt=0)] | None = None
    decimate_to_Hz: Annotated[float, Meta(gt=0)] | None = None
    speed_threshold_rad_s: Annotated[float, Meta(ge=0)] | None = None
    offsets: bool | None = None


class IdentifyRequest(Message, frozen=True):
    """Recordings to parameters.

    Attributes:
        id: Chosen by the client, repeated in the log of the service.
        methods: The key's method is one of them.
        runs, validation: Recordings to fit and recordings to judge by.
        robot_toml: Robot file that replaces the one attached to the recordings.
        html, model: Also return the report and the identified robot file.
        truth: Base parameters that the requester knows, of an emulated machine: shown beside the estimates, never
            used to make them.
    """

    id: Name
    methods: Annotated[list[Method], Meta(min_length=1, max_length=len(get_args(Method)))]
    runs: Annotated[list[Attached | Logged], Meta(min_length=1, max_length=64)]
    validation: Annotated[list[Attached | Logged], Meta(max_length=64)] = []
    robot_toml: str | None = None
    options: Options = msgspec.field(default_factory=Options)
    html: bool = True
    model: bool = False
    truth: dict[str, float] = {}


class Accepted(Message, frozen=True, tag="accepted", tag_field="reply"):
    """The request is understood and has started, within `ACCEPT_WITHIN_S`."""

    id: str
    version: str


class Progress(Message, frozen=True, tag="progress", tag_field="reply"):
    """How far the work is, 0 to 1, and what is being done."""

    fraction: Annotated[float, Meta(ge=0, le=1)]
    stage: str


class Chunk(Message, frozen=True, tag="chunk", tag_field="reply"):
    """Bytes of one part of the result follow the JSON line.

    Attributes:
        index: 0, 1, ... over all parts.
        part: `result` is the JSON of `identify --json`, `html` the report, `model` the robot file.
    """

    index: Count
    part: Part
    bytes: Count


class Failure(Message, frozen=True, tag="error", tag_field="reply"):
    """Why there is no result: one sentence with numbers and what to do."""

    code: ErrorCode
    message: str


class Done(Message, frozen=True, tag="done", tag_field="reply"):
    """Always the last reply.

    Attributes:
        count, bytes, sha256: Of all chunks, their bytes one after the other.
    """

    status: Status
    count: Count
    bytes: Count
    sha256: Sha256


Reply = Accepted | Progress | Chunk | Failure | Done

# --- logs ---


class LogInfo(Message, frozen=True):
    """Entry of the log server's index.

    Attributes:
        verdict: `LOSSLESS`, `GAPS(n)` or `UNVERIFIABLE`.
        robot: Name of the robot.
    """

    id: LogId
    bytes: Count
    sha256: Sha256
    verdict: str
    robot: str


class Range(Message, frozen=True):
    """Parameters of a range get, `armrig/log/ID?offset=0;count=4194304`."""

    offset: Count
    count: Annotated[int, Meta(ge=1, le=RANGE_BYTES)]


class RangeReply(Message, frozen=True):
    """`bytes` bytes of the log from `offset` on follow the JSON line; fewer than asked for only at its end."""

    id: LogId
    offset: Count
    bytes: Count
    total_bytes: Count


def ranges(total_bytes: int) -> Iterator[Range]:
    """Range gets that fetch a whole log."""
    for offset in range(0, total_bytes, RANGE_BYTES):
        yield Range(offset=offset, count=min(RANGE_BYTES, total_bytes - offset))


def range_selector(log_id: str, wanted: Range) -> str:
    """Zenoh selector of a range get."""
    return f"{log_key(log_id)}?offset={wanted.offset};count={wanted.count}"


def parse_range(parameters: dict[str, str]) -> Range:
    """Range of a query's parameters.

    Raises:
        ConfigError: A parameter is missing, not a number or out of range.
    """
    try:
        return msgspec.convert(parameters, Range, strict=False)
    except msgspec.ValidationError as error:
        raise ConfigError(
            f"Log range {parameters} refused: {error}. Give offset >= 0 and count from 1 to {RANGE_BYTES}."
        ) from error


# --- envelope ---


def encode(message: Message, body: bytes = b"") -> bytes:
    """Payload of a message, `body` being the raw bytes it announces."""
    return msgspec.json.encode(message) + b"\n" + body if body else msgspec.json.encode(message)


def decode(payload: bytes, kind: type[T]) -> tuple[T, bytes]:
    """Message and raw bytes of a payload.

    Raises:
        ConfigError: Empty, no JSON, or not of this type; names the place in the JSON.
    """
    header, _, body = payload.partition(b"\n")
    if not header.strip():
        raise ConfigError("The message is empty; one line of JSON is expected first.")
    if len(header) > MAX_HEADER_BYTES:
        raise ConfigError(f"The message's JSON line has {len(header)} bytes; at most {MAX_HEADER_BYTES} are read.")
    try:
        return msgspec.json.decode(header, type=kind), body
    except msgspec.DecodeError as error:  # ValidationError, which carries the path, is one
        raise ConfigError(f"The message is not valid: {error}.") from error


def decode_reply(payload: bytes) -> tuple[Reply, bytes]:
    """`decode` for any reply of the identification service."""
    reply: tuple[Reply, bytes] = decode(payload, Reply)  # type: ignore[arg-type]  # a union is no type[T] to mypy
    return reply


def split(recordings: list[Attached], body: bytes) -> list[bytes]:
    """Bytes of each attached recording.

    Raises:
        ConfigError: Length or checksum is not what the request announces.
    """
    expected = sum(r.bytes for r in recordings)
    if expected != len(body):
        raise ConfigError(f"The request announces {expected} bytes of recordings, but {len(body)} follow.")
    parts, start = [], 0
    for recording in recordings:
        part = body[start : start + recording.bytes]
        if sha256(part) != recording.sha256:
            raise ConfigError(f"{recording.name}: the sha256 of the {len(part)} bytes received does not match.")
        parts.append(part)
        start += recording.bytes
    return parts


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def done(status: Status, count: int, data: bytes) -> Done:
    """Last reply after `count` chunks with `data` in them."""
    return Done(status=status, count=count, bytes=len(data), sha256=sha256(data))


# --- failures across the wire ---


def failure(error: ArmrigError) -> Failure:
    """What the requester is told of an error."""
    codes: dict[type[ArmrigError], ErrorCode] = {
        ConfigError: "configuration",
        DataError: "data",
        IdentificationError: "not-identifiable",
        PeerError: "peer",
    }
    return Failure(code=codes.get(type(error), "bug"), message=str(error))


def as_error(reply: Failure) -> ArmrigError:
    """The error a requester raises, so that exit codes are the same near and far."""
    kinds: dict[str, type[ArmrigError]] = {
        "bad-request": ConfigError,
        "too-large": ConfigError,
        "configuration": ConfigError,
        "not-found": DataError,
        "data": DataError,
        "not-identifiable": IdentificationError,
    }
    return kinds.get(reply.code, PeerError)(reply.message)


def json_schema() -> dict[str, Any]:
    """JSON Schema of every message."""
    kinds = (IdentifyRequest, Accepted, Progress, Chunk, Failure, Done, LogInfo, Range, RangeReply)
    _, components = msgspec.json.schema_components(kinds, ref_template="#/$defs/{name}")
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "armrig messages", "$defs": components}
