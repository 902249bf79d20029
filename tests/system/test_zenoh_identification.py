"""The service on Zenoh, on loopback: streamed answers, every refusal, and silence told apart."""

import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest
import zenoh

from ident import zenoh_service
from ident.contract import from_json
from ident.dataset import Signals
from ident.service import Service
from ident.zenoh_client import request
from ident.zenoh_service import ZenohService
from ident.zenoh_session import client, router
from protocols import messages
from protocols.errors import ConfigError, DataError, PeerError
from protocols.robot import Robot

pytestmark = pytest.mark.system


def free_endpoint() -> str:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{s.getsockname()[1]}"


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    where = free_endpoint()
    service = ZenohService(where, "0.0", lambda line: None)
    yield where
    service.close()


@pytest.fixture(scope="module")
def recording(
    tx40: Robot, make_signals: Callable[..., Signals], make_recording: Callable[[Robot, Signals], bytes]
) -> bytes:
    return make_recording(tx40, make_signals(tx40, 1, 8.0, noise_Nm=0.3, delay_s=0.0005))


def by_payload(data: bytes, **changes: object) -> messages.IdentifyRequest:
    attached = messages.Attached(name="run.mcap", bytes=len(data), sha256=messages.sha256(data))
    return messages.IdentifyRequest(id="r", methods=["wls"], runs=[attached], **changes)


def by_log(log: str) -> messages.IdentifyRequest:
    return messages.IdentifyRequest(id="r", methods=["wls"], runs=[messages.Logged(log=log)], html=False)


@pytest.fixture
def log_server(endpoint: str, recording: bytes) -> Iterator[dict[str, messages.LogInfo]]:
    """A log server of the protocol, with one good log and one whose checksum is wrong."""
    good = messages.LogInfo(
        id="good", bytes=len(recording), sha256=messages.sha256(recording), verdict="LOSSLESS", robot="TX40"
    )
    logs = {
        "good": good,
        "bad": messages.LogInfo(id="bad", bytes=good.bytes, sha256="0" * 64, verdict="LOSSLESS", robot="TX40"),
    }

    def serve(query: zenoh.Query) -> None:
        with query:
            log_id = str(query.key_expr).rpartition("/")[2]
            parameters = dict(p.split("=") for p in str(query.parameters).split(";") if p)
            if log_id not in logs:
                query.reply_err(messages.encode(messages.Failure(code="not-found", message=f"No log {log_id}.")))
            elif not parameters:
                query.reply(query.key_expr, messages.encode(logs[log_id]))
            else:
                wanted = messages.parse_range(parameters)
                part = recording[wanted.offset : wanted.offset + wanted.count]
                reply = messages.RangeReply(
                    id=log_id, offset=wanted.offset, bytes=len(part), total_bytes=len(recording)
                )
                query.reply(query.key_expr, messages.encode(reply, part))

    with client(endpoint) as session:
        queryable = session.declare_queryable(messages.log_key("*"), serve)
        yield logs
        queryable.undeclare()


def test_a_recording_goes_there_and_an_answer_comes_back(endpoint: str, recording: bytes) -> None:
    stages: list[str] = []
    answer = request(endpoint, by_payload(recording), recording, lambda fraction, stage: stages.append(stage))
    (result,) = from_json(answer.parts["result"])
    assert result.method == "IDIM-WLS"
    assert answer.parts["html"].startswith(b"<!doctype html>")
    assert stages[0] == "reading recordings" and "report" in stages


def test_a_log_is_fetched_by_its_key(endpoint: str, log_server: dict[str, messages.LogInfo]) -> None:
    (result,) = from_json(request(endpoint, by_log("good")).parts["result"])
    assert result.recordings[0].sha256 == log_server["good"].sha256


def test_a_wrong_log_is_named(endpoint: str, log_server: dict[str, messages.LogInfo]) -> None:
    with pytest.raises(DataError, match="No log other"):
        request(endpoint, by_log("other"))
    with pytest.raises(DataError, match="Log bad: the sha256 of the"):
        request(endpoint, by_log("bad"))


def test_no_log_server_is_said(endpoint: str) -> None:
    with pytest.raises(PeerError, match="No log server offers log good"):
        request(endpoint, by_log("good"))


def test_nobody_there_is_said_within_three_seconds() -> None:
    start = time.monotonic()
    with pytest.raises(PeerError, match="No Zenoh router answers at tcp/127.0.0.1:"):
        request(free_endpoint(), by_log("a"))
    assert time.monotonic() - start < messages.PEER_TIMEOUT_S


def test_a_router_without_service_is_told_apart() -> None:
    where = free_endpoint()
    with router(where):
        start = time.monotonic()
        with pytest.raises(PeerError, match="knows no identification service; start `armrig serve` there"):
            request(where, by_log("a"))
        assert time.monotonic() - start < messages.PEER_TIMEOUT_S


def test_an_endpoint_that_is_taken_is_said(endpoint: str) -> None:
    with pytest.raises(PeerError, match=f"Zenoh cannot listen on {endpoint}"):
        router(endpoint)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xff\xfe",
        b"null",
        b'{"id":1}',
        b'{"id":"r","methods":["wls"],"runs":[{"source":"log","log":"a"}],"x":NaN}',
    ],
)
def test_a_malformed_request_gets_an_error_and_the_last_reply(endpoint: str, payload: bytes) -> None:
    with client(endpoint) as session:
        start = time.monotonic()
        replies = list(
            session.get(
                messages.identify_key("wls"),
                payload=payload,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=5.0,
            )
        )
        assert time.monotonic() - start < 2.0
    failure, _ = messages.decode_reply(replies[0].err.payload.to_bytes())
    assert isinstance(failure, messages.Failure) and failure.code == "bad-request"
    done, _ = messages.decode_reply(replies[-1].ok.payload.to_bytes())
    assert isinstance(done, messages.Done) and done.status == "failed"


def test_a_request_for_a_key_that_is_not_its_method_is_refused(endpoint: str) -> None:
    with client(endpoint) as session:
        (error, done) = session.get(
            messages.identify_key("ols"),
            payload=messages.encode(by_log("a")),
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=5.0,
        )
    assert b"send it to armrig/identify/wls" in error.err.payload.to_bytes()
    assert done.ok is not None


def test_a_long_job_does_not_block_and_too_many_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    release, started = threading.Event(), threading.Event()

    def work(self: Service, job: object, send: Callable[[bytes], None]) -> None:
        started.set()
        release.wait(20.0)
        send(messages.encode(messages.done("ok", 0, b"")))

    monkeypatch.setattr(Service, "work", work)
    monkeypatch.setattr(zenoh_service, "WAITING", 2)
    where = free_endpoint()
    service = ZenohService(where, "0.0", lambda line: None)
    try:
        with client(where) as session:

            def ask() -> Iterator[zenoh.Reply]:
                return session.get(
                    messages.identify_key("wls"),
                    payload=messages.encode(by_log("a")),
                    consolidation=zenoh.ConsolidationMode.NONE,
                    timeout=30.0,
                )

            first = ask()
            assert started.wait(5.0)
            begun = time.monotonic()
            second = ask()
            accepted, _ = messages.decode_reply(second.recv().ok.payload.to_bytes())
            assert isinstance(accepted, messages.Accepted)
            assert time.monotonic() - begun < 1.0  # 0.1 s on a machine that is not shared with other tests
            with pytest.raises(PeerError, match="The service has 2 requests in hand"):
                request(where, by_log("a"))
            release.set()
            for replies in (first, second):
                last = list(replies)[-1]
                assert isinstance(messages.decode_reply(last.ok.payload.to_bytes())[0], messages.Done)
    finally:
        release.set()
        service.close()


def test_a_bug_ends_its_request_and_not_the_service(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def work(self: Service, job: object, send: Callable[[bytes], None]) -> None:
        raise ZeroDivisionError("division by zero")

    with monkeypatch.context() as patch:
        patch.setattr(Service, "work", work)
        with pytest.raises(PeerError, match="ZeroDivisionError in the identification service: division by zero"):
            request(endpoint, by_log("a"))
    with pytest.raises(PeerError, match="No log server"):
        request(endpoint, by_log("a"))


def test_a_bad_option_is_a_configuration_error_here_as_there(endpoint: str, recording: bytes) -> None:
    with pytest.raises(ConfigError, match="filter_Hz = 499"):
        request(endpoint, by_payload(recording, options=messages.Options(filter_Hz=499.0)), recording)
