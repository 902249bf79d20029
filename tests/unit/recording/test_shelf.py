"""What the log server offers, without Zenoh: ids, never paths."""

import hashlib

import pytest

from daq.shelf import Shelf
from protocols import messages
from protocols.errors import ConfigError, DataError


@pytest.fixture
def shelf(wire, record):
    path = record(wire.cycles(100), "A run: 1.mcap").path
    shelf = Shelf([path, path])
    yield shelf, path
    shelf.close()


def test_a_recording_is_fetched_by_ranges(shelf):
    shelf, path = shelf
    assert shelf.ids == ["A-run-1", "A-run-1-2"]
    info, _ = messages.decode(shelf.answer("A-run-1", {}), messages.LogInfo)
    assert (info.id, info.robot, info.verdict) == ("A-run-1", "TX40", "LOSSLESS")
    path.unlink()  # what is offered stays
    data = b""
    while len(data) < info.bytes:
        payload = shelf.answer("A-run-1", {"offset": str(len(data)), "count": "5000"})
        reply, body = messages.decode(payload, messages.RangeReply)
        assert (reply.offset, reply.bytes, reply.total_bytes) == (len(data), len(body), info.bytes)
        data += body
    assert hashlib.sha256(data).hexdigest() == info.sha256


@pytest.mark.parametrize(
    "name", ["../A-run-1", "..", "/etc/passwd", "A-run-1\0", "x" * 300, "**", "$*", "Läuft", "", "A-run-1.mcap"]
)
def test_names_that_are_no_ids_are_refused(shelf, name):
    with pytest.raises(DataError, match=r"There is no log .*; offered are A-run-1, A-run-1-2"):
        shelf[0].answer(name, {"offset": "0", "count": "10"})


@pytest.mark.parametrize(
    "parameters",
    [{"offset": "-1", "count": "1"}, {"offset": "0", "count": "0"}, {"offset": "0", "count": str(1 << 30)},
     {"offset": "NaN", "count": "1"}, {"offset": "0"}, {"path": "x"}],
)  # fmt: skip
def test_ranges_that_make_no_sense_are_refused(shelf, parameters):
    with pytest.raises(ConfigError, match="Log range .* refused"):
        shelf[0].answer("A-run-1", parameters)


def test_behind_the_end(shelf):
    with pytest.raises(DataError, match=r"has \d+ bytes; there are none from 999999999 on"):
        shelf[0].answer("A-run-1", {"offset": "999999999", "count": "1"})


def test_a_damaged_recording_is_not_offered(tmp_path):
    (tmp_path / "bad.mcap").write_bytes(b"nothing")
    with pytest.raises(DataError, match="is not an MCAP file"):
        Shelf([tmp_path / "bad.mcap"])
