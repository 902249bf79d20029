"""Edge: the identification service on Zenoh, one queryable per method."""

import functools
import threading
from concurrent.futures import ThreadPoolExecutor

import zenoh

from ident.service import Job, RefusedError, Service
from ident.zenoh_session import Log, fetch_log, router
from protocols import messages

WAITING = 4  # accepted jobs, the running one included: a fifth would wait longer than its client does


class ZenohService:
    """Listens until closed. Jobs run one at a time on a worker, so that queries are answered at once."""

    def __init__(self, endpoint: str, version: str, log: Log) -> None:
        """
        Args:
            endpoint: To listen on, `tcp/127.0.0.1:7447`.
            log: Told one line about each request.

        Raises:
            PeerError: The endpoint cannot be listened on.
        """
        self._session = router(endpoint)
        self._service = Service(lambda log_id: fetch_log(self._session, log_id), version)
        self._log = log
        self._slots = threading.BoundedSemaphore(WAITING)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="identify")
        self._queryables = [
            self._session.declare_queryable(messages.identify_key(method), functools.partial(self._on_query, method))
            for method in messages.METHODS
        ]
        # Last, since a client looks for it before it asks; kept, since a dropped token is undeclared.
        self._token = self._session.liveliness().declare_token(messages.alive_key("identify"))

    def close(self) -> None:
        """Finish the running job, refuse those waiting, and leave; joins the worker before the interpreter exits."""
        self._token.undeclare()  # type: ignore[no-untyped-call]
        for queryable in self._queryables:
            queryable.undeclare()  # type: ignore[no-untyped-call]
        self._worker.shutdown(wait=True, cancel_futures=True)
        self._session.close()  # type: ignore[no-untyped-call]

    def _on_query(self, method: str, query: zenoh.Query) -> None:
        key = messages.identify_key(method)
        payload = query.payload.to_bytes() if query.payload is not None else b""
        try:
            job = self._service.accept(method, payload)
            if not self._slots.acquire(blocking=False):
                raise RefusedError("busy", f"The service has {WAITING} requests in hand; ask again when they are done.")
        except RefusedError as refusal:
            self._log(f"{key}: refused, {refusal}")
            with query:
                _fail(query, key, messages.Failure(code=refusal.code, message=str(refusal)))
            return
        self._log(f"{key}: accepted {job.request.id}")
        query.reply(key, self._service.accepted(job))
        self._worker.submit(self._run, key, query, job)

    def _run(self, key: str, query: zenoh.Query, job: Job) -> None:
        def send(payload: bytes) -> None:
            query.reply(key, payload)

        try:
            with query:  # a query that is kept alive after its replies ends in a timeout at the client
                try:
                    self._service.work(job, send)
                except Exception as error:  # noqa: BLE001  (top loop: a bug must end this request, not the service)
                    bug = f"{type(error).__name__} in the identification service: {error}. Please report it."
                    _fail(query, key, messages.Failure(code="bug", message=bug))
            self._log(f"{key}: finished {job.request.id}")
        finally:
            self._slots.release()


def _fail(query: zenoh.Query, key: str, failure: messages.Failure) -> None:
    query.reply_err(messages.encode(failure))
    query.reply(key, messages.encode(messages.done("failed", 0, b"")))
