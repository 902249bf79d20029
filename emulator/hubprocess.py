"""The hub in a process of its own, so that forwarding frames and simulating the arm share no interpreter."""

import multiprocessing
import signal
import threading
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Self

from emulator.hub import Hub
from emulator.priority import real_time
from protocols.errors import ArmrigError, PeerError

STOP_S = 5.0


class HubProcess:
    """A running hub; ends with `close`, and by itself when this process dies.

    Args:
        buses: As `Hub`.

    Attributes:
        channels: Channel of each bus by name, with the port that was really bound.

    Raises:
        PeerError: A channel cannot be listened on.
    """

    def __init__(self, buses: Sequence[tuple[str, str]]) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would copy this process' sockets and threads
        self._pipe, far = context.Pipe()
        self._process = context.Process(target=_run, args=(list(buses), far), name="armrig-hub", daemon=True)
        self._process.start()
        far.close()
        try:
            answer: dict[str, str] | str = self._pipe.recv()
        except EOFError:
            raise PeerError(f"the CAN hub ended at once with exit code {self._process.exitcode}.") from None
        if isinstance(answer, str):
            raise PeerError(answer)
        self.channels = answer

    def close(self) -> None:
        self._pipe.close()
        self._process.join(STOP_S)
        if self._process.is_alive():
            self._process.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _run(buses: list[tuple[str, str]], pipe: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the owner decides when we end
    try:
        hub = Hub(buses)
    except ArmrigError as error:
        pipe.send(str(error))
        return

    def until_the_owner_is_gone() -> None:
        pipe.poll(None)
        hub.stop()

    real_time()
    with hub:
        pipe.send(hub.channels)
        threading.Thread(target=until_the_owner_is_gone, daemon=True).start()
        hub.run()
