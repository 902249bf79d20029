"""Edge: ask the identification service and collect its streamed answer."""

import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import zenoh

from ident.zenoh_session import client
from protocols import messages
from protocols.errors import PeerError

TRIES = 3  # a liveliness token may be seen late just after a connection
BETWEEN_S = 0.2
WAIT_S = 600.0  # for the whole answer


@dataclass
class Answer:
    """Parts of a finished request."""

    parts: dict[str, bytes] = field(default_factory=dict)


def request(
    endpoint: str,
    request: messages.IdentifyRequest,
    body: bytes = b"",
    progress: Callable[[float, str], None] = lambda fraction, stage: None,
    timeout_s: float = WAIT_S,
) -> Answer:
    """Send a request and wait for all of its answer.

    Args:
        body: Bytes of the attached recordings, in the order of the request.

    Raises:
        PeerError: No router, no service, or the answer broke off or arrived damaged.
        ArmrigError: What the service reports, of the same kind as if it had happened here.
    """
    with client(endpoint) as session:
        _find(session, endpoint)
        replies = session.get(
            messages.identify_key(request.methods[0]),
            payload=messages.encode(request, body),
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s,
        )
        return collect(_payloads(replies, timeout_s), progress)


def _find(session: zenoh.Session, endpoint: str) -> None:
    """Tell 'no service' from 'no answer' before asking."""
    for attempt in range(TRIES):
        if attempt:
            threading.Event().wait(BETWEEN_S)
        tokens = session.liveliness().get(messages.alive_key("identify"), timeout=messages.PEER_TIMEOUT_S / 6)
        if any(token.ok is not None for token in tokens):
            return
    raise PeerError(f"The router at {endpoint} knows no identification service; start `armrig serve` there.")


def _payloads(replies: Iterable[zenoh.Reply], timeout_s: float) -> Iterator[bytes]:
    for reply in replies:
        if reply.ok is not None:
            yield reply.ok.payload.to_bytes()
        elif reply.err is not None:
            payload = reply.err.payload.to_bytes()
            if payload == b"Timeout":  # zenoh's own word for it
                raise PeerError(f"The identification service did not finish within {timeout_s:g} s.")
            yield payload


def collect(payloads: Iterable[bytes], progress: Callable[[float, str], None]) -> Answer:
    """Put an answer together from its replies.

    Raises:
        PeerError: The last reply is missing, or chunks are missing or damaged.
        ArmrigError: What the service reports.
    """
    answer, received, count = Answer(), bytearray(), 0
    failure: messages.Failure | None = None
    for payload in payloads:
        reply, body = messages.decode_reply(payload)
        if isinstance(reply, messages.Progress):
            progress(reply.fraction, reply.stage)
        elif isinstance(reply, messages.Chunk):
            if reply.index != count or reply.bytes != len(body):
                raise PeerError(f"Part {reply.index} of the answer came as number {count} with {len(body)} bytes.")
            answer.parts[reply.part] = answer.parts.get(reply.part, b"") + body
            received += body
            count += 1
        elif isinstance(reply, messages.Failure):
            failure = reply
        elif isinstance(reply, messages.Done):
            if failure is not None or reply.status == "failed":
                raise messages.as_error(
                    failure or messages.Failure(code="bug", message="The service failed and gave no reason.")
                )
            if reply != messages.done("ok", count, bytes(received)):
                raise PeerError(
                    f"The answer arrived damaged: {count} parts with {len(received)} bytes, {reply.count} with"
                    f" {reply.bytes} were sent, or their sha256 differs. Ask again."
                )
            return answer
    if failure is not None:
        raise messages.as_error(failure)
    raise PeerError(f"The answer broke off after {count} parts; the service or the router went away. Ask again.")
