"""Zenoh messages: envelope round trip, refusals with their sentences, schema."""

import json

import msgspec
import pytest

from protocols import messages as m
from protocols.errors import ConfigError, DataError, IdentificationError, PeerError

LOG = b'"runs":[{"source":"log","log":"a"}]'


def request(**changes: object) -> m.IdentifyRequest:
    attached = m.Attached(name="a.mcap", bytes=3, sha256=m.sha256(b"abc"))
    return msgspec.structs.replace(
        m.IdentifyRequest(id="r1", methods=["wls"], runs=[attached, m.Logged(log="run-1")]), **changes
    )


def test_a_request_and_its_recording_survive_the_envelope() -> None:
    payload = m.encode(request(), b"abc")
    decoded, body = m.decode(payload, m.IdentifyRequest)
    assert decoded == request()
    assert m.split([r for r in decoded.runs if isinstance(r, m.Attached)], body) == [b"abc"]


@pytest.mark.parametrize(
    "reply",
    [
        m.Accepted(id="r1", version="0.1.0"),
        m.Progress(fraction=0.5, stage="fit"),
        m.Chunk(index=0, part="html", bytes=0),
        m.Failure(code="data", message="x"),
        m.Done(status="ok", count=1, bytes=3, sha256=m.sha256(b"abc")),
    ],
)
def test_every_reply_is_told_apart_by_its_tag(reply: m.Reply) -> None:
    assert m.decode(m.encode(reply), m.Reply)[0] == reply


@pytest.mark.parametrize(
    ("payload", "sentence"),
    [
        (b"", "The message is empty; one line of JSON is expected first."),
        (b"{not json", "The message is not valid: JSON is malformed"),
        (b"[]", "Expected `object`, got `array`"),
        (
            b'{"id":"x","methods":["magic"],"runs":[{"source":"log","log":"a"}]}',
            "Invalid enum value 'magic' - at `$.methods[0]`",
        ),
        (b'{"id":"x","methods":["wls"],"runs":[]}', "length >= 1 - at `$.runs`"),
        (b'{"id":"x","methods":["wls"],"runs":[{"source":"log","log":"../etc"}]}', "$.runs[0]"),
        (b'{"id":"x","methods":["wls"],' + LOG + b',"options":{"filter_Hz":NaN}}', "malformed"),
        (
            b'{"id":"x","methods":["wls"],"runs":[{"source":"log","log":"a"}],"options":{"filter_Hz":"5"}}',
            "$.options.filter_Hz",
        ),
        (b'{"id":"x","methods":["wls"],' + LOG + b',"colour":1}', "unknown field `colour`"),
    ],
)
def test_a_malformed_request_is_refused_with_the_place(payload: bytes, sentence: str) -> None:
    with pytest.raises(ConfigError) as error:
        m.decode(payload, m.IdentifyRequest)
    assert sentence in str(error.value)


def test_announced_and_received_bytes_must_agree() -> None:
    attached = [m.Attached(name="a.mcap", bytes=3, sha256=m.sha256(b"abc"))]
    with pytest.raises(ConfigError, match="announces 3 bytes of recordings, but 2 follow"):
        m.split(attached, b"ab")
    with pytest.raises(ConfigError, match=r"a\.mcap: the sha256 of the 3 bytes received does not match"):
        m.split(attached, b"abd")


def test_ranges_cover_a_log_exactly() -> None:
    total = 2 * m.RANGE_BYTES + 5
    wanted = list(m.ranges(total))
    assert [(r.offset, r.count) for r in wanted] == [
        (0, m.RANGE_BYTES),
        (m.RANGE_BYTES, m.RANGE_BYTES),
        (2 * m.RANGE_BYTES, 5),
    ]
    assert m.range_selector("run-1", wanted[2]) == f"armrig/log/run-1?offset={2 * m.RANGE_BYTES};count=5"
    assert m.parse_range({"offset": "0", "count": "7"}) == m.Range(offset=0, count=7)


@pytest.mark.parametrize("parameters", [{}, {"offset": "-1", "count": "1"}, {"offset": "0", "count": "x"}])
def test_a_range_out_of_bounds_is_refused(parameters: dict[str, str]) -> None:
    with pytest.raises(ConfigError, match="Give offset >= 0 and count from 1 to"):
        m.parse_range(parameters)


@pytest.mark.parametrize("kind", [ConfigError, DataError, IdentificationError, PeerError])
def test_an_error_keeps_its_kind_and_sentence_across_the_wire(kind: type[PeerError]) -> None:
    back = m.as_error(m.failure(kind("what happened")))
    assert type(back) is kind
    assert str(back) == "what happened"


def test_the_schema_names_every_message() -> None:
    schema = json.loads(json.dumps(m.json_schema()))
    assert {"IdentifyRequest", "Done", "Failure", "LogInfo", "RangeReply"} <= set(schema["$defs"])
