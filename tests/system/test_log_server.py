"""Recordings offered over Zenoh on loopback, and what their absence looks like."""

import hashlib
import io
import socket
import time
from pathlib import Path

import pytest
import zenoh
from mcap.writer import Writer

from daq.serve import LogServer
from ident.zenoh_session import client, router
from protocols import messages
from protocols.errors import PeerError

pytestmark = pytest.mark.system


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


@pytest.fixture
def endpoint():
    place = f"tcp/127.0.0.1:{free_port()}"
    session = router(place)
    yield place
    session.close()


@pytest.fixture
def path(tmp_path) -> Path:
    """More than one range of incompressible bytes."""
    out = io.BytesIO()
    writer = Writer(out)
    writer.start()
    writer.add_attachment(0, 0, "noise", "application/octet-stream", hashlib.shake_256(b"x").digest(9 << 20))
    writer.finish()
    (tmp_path / "long.mcap").write_bytes(out.getvalue())
    return tmp_path / "long.mcap"


def get(session: zenoh.Session, selector: str) -> list[tuple[bool, bytes]]:
    replies = session.get(selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=10.0)
    return [(r.ok is not None, (r.ok or r.err).payload.to_bytes()) for r in replies]


def test_ranges_give_the_file_and_its_checksum(endpoint, path):
    with LogServer(endpoint, [path]) as server:
        assert server.keys == ["long"]
        session = client(endpoint)
        [(ok, payload)] = get(session, messages.log_key("*"))
        assert ok
        info, _ = messages.decode(payload, messages.LogInfo)
        data = b""
        for wanted in messages.ranges(info.bytes):
            [(ok, payload)] = get(session, messages.range_selector("long", wanted))
            _, body = messages.decode(payload, messages.RangeReply)
            data += body
        assert data == path.read_bytes()
        assert hashlib.sha256(data).hexdigest() == info.sha256
        session.close()


def test_refusals_are_errors_and_not_silence(endpoint, path):
    with LogServer(endpoint, [path]):
        session = client(endpoint)
        [(ok, payload)] = get(session, "armrig/log/long?offset=0;count=999999999")
        failure, _ = messages.decode(payload, messages.Failure)
        assert (ok, failure.code) == (False, "configuration")
        assert "count from 1 to 4194304" in failure.message
        assert get(session, "armrig/log/other") == []
        assert get(session, "armrig/log/../long") == []
        session.close()


def test_a_liveliness_token_tells_a_server_from_none(endpoint, path):
    session = client(endpoint)

    def alive() -> list[str]:
        return [str(r.ok.key_expr) for r in session.liveliness().get(messages.alive_key("log"), timeout=5.0) if r.ok]

    def soon(expected: list[str]) -> bool:
        """Declarations travel on their own; ask until they have arrived."""
        deadline = time.monotonic() + 5.0
        while alive() != expected:
            if time.monotonic() > deadline:
                return False
        return True

    assert alive() == []
    with LogServer(endpoint, [path]):
        assert soon(["armrig/alive/log"])
    assert soon([])
    session.close()


def test_no_router_is_said(path):
    place = f"tcp/127.0.0.1:{free_port()}"
    with pytest.raises(PeerError, match=f"No Zenoh router answers at {place} .* start `armrig serve` first"):
        LogServer(place, [path])
