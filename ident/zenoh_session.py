"""Edge: Zenoh sessions with explicit endpoints, and recordings fetched from the log server.

Never a bare `zenoh.Config()`: the default multicasts on the local network and listens on every interface.
"""

import hashlib
import json
from collections.abc import Callable
from typing import Any

import zenoh

from protocols import messages
from protocols.errors import ConfigError, DataError, PeerError

Log = Callable[[str], None]

MESSAGE_BYTES = 128 << 20  # largest message received: a request with its recordings, and room


def router(endpoint: str) -> zenoh.Session:
    """Session that others connect to; routes between them as zenohd would.

    Raises:
        PeerError: The endpoint is taken or malformed.
    """
    settings = {"mode": "router", "listen/endpoints": [endpoint]}
    return _open(settings, f"Zenoh cannot listen on {endpoint}; is another service there, or the address not local?")


def client(endpoint: str) -> zenoh.Session:
    """Session connected to a router.

    Raises:
        PeerError: Nobody answers there within `PEER_TIMEOUT_S`.
    """
    settings = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": int(1000 * messages.PEER_TIMEOUT_S * 0.5),
    }
    return _open(settings, f"No Zenoh router answers at {endpoint}; start `armrig serve` or give --connect.")


def _open(settings: dict[str, Any], trouble: str) -> zenoh.Session:
    config = zenoh.Config()
    common = {
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/rx/max_message_size": MESSAGE_BYTES,
    }
    try:
        for key, value in (settings | common).items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise PeerError(f"{trouble} ({str(error).splitlines()[0][:160]})") from error


def fetch_log(session: zenoh.Session, log_id: str) -> bytes:
    """A recording from the log server, by range gets, checked against its sha256.

    Raises:
        PeerError: No log server, or it stopped answering.
        DataError: The log is unknown, too large, or does not match its checksum.
    """
    payload = _one(session, messages.log_key(log_id), log_id)
    info, _ = messages.decode(payload, messages.LogInfo)
    if info.bytes > messages.MAX_LOG_BYTES:
        raise DataError(f"Log {log_id} has {info.bytes} bytes; at most {messages.MAX_LOG_BYTES} are fetched.")
    data = bytearray()
    digest = hashlib.sha256()
    for wanted in messages.ranges(info.bytes):
        reply, body = messages.decode(
            _one(session, messages.range_selector(log_id, wanted), log_id), messages.RangeReply
        )
        if reply.offset != wanted.offset or len(body) != wanted.count:
            raise DataError(f"Log {log_id}: {len(body)} bytes came for the {wanted.count} from {wanted.offset} on.")
        data += body
        digest.update(body)
    if digest.hexdigest() != info.sha256:
        raise DataError(f"Log {log_id}: the sha256 of the {len(data)} bytes fetched does not match the server's.")
    return bytes(data)


def _one(session: zenoh.Session, selector: str, log_id: str) -> bytes:
    """Payload of the only reply to a get."""
    replies = session.get(selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=10.0)
    for reply in replies:
        if reply.ok is not None:
            return reply.ok.payload.to_bytes()
        try:
            failure, _ = messages.decode(reply.err.payload.to_bytes() if reply.err else b"", messages.Failure)
        except ConfigError:  # zenoh's own error, a timeout for one
            raise PeerError(f"The log server did not answer for log {log_id} in 10 s.") from None
        raise messages.as_error(failure)
    raise PeerError(f"No log server offers log {log_id}; is the recorder's log service running on this router?")
