"""Edge: finished recordings offered over Zenoh, for an identification service or any other client."""

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from types import TracebackType

import zenoh

from daq.shelf import Shelf
from protocols import messages
from protocols.errors import ArmrigError, PeerError


class LogServer:
    """Offers recordings at a Zenoh router until closed; use as a context.

    Attributes:
        keys: Log ids, in the order of the recordings.
    """

    def __init__(self, endpoint: str, recordings: Sequence[Path]) -> None:
        """
        Args:
            endpoint: Of the router, `tcp/127.0.0.1:7447`; `armrig serve` is one.

        Raises:
            DataError: A recording is unreadable or damaged.
            PeerError: No router answers there.
        """
        self._shelf = Shelf(recordings)
        self.keys = self._shelf.ids
        try:
            self._session = _client(endpoint)
        except PeerError:
            self._shelf.close()
            raise
        # One queryable per log: several servers may stand at one router, and a list is what all of them answer.
        self._queryables = [
            self._session.declare_queryable(messages.log_key(key), partial(self._on_query, key)) for key in self.keys
        ]
        # Last, since a client looks for it before it asks; kept, since a dropped token is undeclared.
        self._token = self._session.liveliness().declare_token(messages.alive_key("log"))

    def __enter__(self) -> "LogServer":
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Withdraw the offer."""
        self._token.undeclare()  # type: ignore[no-untyped-call]
        for queryable in self._queryables:
            queryable.undeclare()  # type: ignore[no-untyped-call]
        self._session.close()  # type: ignore[no-untyped-call]
        self._shelf.close()

    def _on_query(self, log_id: str, query: zenoh.Query) -> None:
        pairs = (part.partition("=") for part in str(query.parameters).split(";") if part)
        with query:  # a query that is kept alive after its replies ends in a timeout at the client
            try:
                payload = self._shelf.answer(log_id, {name: value for name, _, value in pairs})
                query.reply(messages.log_key(log_id), payload)
            except ArmrigError as error:
                query.reply_err(messages.encode(messages.failure(error)))
            except Exception as error:  # noqa: BLE001  (top loop: a bug must end this query, not the server)
                bug = f"{type(error).__name__} in the log server: {error}. Please report it."
                query.reply_err(messages.encode(messages.Failure(code="bug", message=bug)))


def _client(endpoint: str) -> zenoh.Session:
    """Session connected to a router; never a bare `zenoh.Config()`, which multicasts and listens everywhere."""
    settings = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": int(1000 * messages.PEER_TIMEOUT_S),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
    }
    config = zenoh.Config()
    try:
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise PeerError(
            f"No Zenoh router answers at {endpoint} for the recordings to be offered; start `armrig serve` first."
            f" ({str(error).splitlines()[0].partition(' at /')[0]})"
        ) from error
