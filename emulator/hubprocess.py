"""The hub in a process of its own, so that forwarding frames and simulating the arm share no interpreter."""

import contextlib
import multiprocessing
import signal
import threading
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection
from typing import Self

from emulator.disturbance import Disturbance
from emulator.hub import Hub
from emulator.priority import real_time
from emulator.wire import Traffic, Wire
from protocols.errors import ArmrigError, PeerError

STOP_S = 5.0


class HubProcess:
    """A running hub; ends with `close`, and by itself when this process dies.

    Args:
        buses, wires: As `Hub`.

    Attributes:
        channels: Channel of each bus by name, with the port that was really bound.

    Raises:
        PeerError: A channel cannot be listened on.
    """

    def __init__(self, buses: Sequence[tuple[str, str]], wires: Mapping[str, Wire] | None = None) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would copy this process' sockets and threads
        self._pipe, far = context.Pipe()
        self._process = context.Process(
            target=_run, args=(list(buses), dict(wires or {}), far), name="armrig-hub", daemon=True
        )
        self._process.start()
        far.close()
        try:
            answer: dict[str, str] | str = self._pipe.recv()
        except EOFError:
            raise PeerError(f"the CAN hub ended at once with exit code {self._process.exitcode}.") from None
        if isinstance(answer, str):
            raise PeerError(answer)
        self.channels = answer

    def disturb(self, disturbance: Disturbance) -> None:
        """From now on this goes wrong, too; its times count from now."""
        self._ask(disturbance)

    def traffic(self) -> dict[str, Traffic]:
        """What each bus with a wire has carried.

        Raises:
            PeerError: The hub has ended.
        """
        return self._ask(None)

    def _ask(self, question: Disturbance | None) -> dict[str, Traffic]:
        try:
            self._pipe.send(question)
            answer: dict[str, Traffic] = self._pipe.recv()
        except (EOFError, OSError) as error:
            raise PeerError(f"the CAN hub has ended with exit code {self._process.exitcode}.") from error
        return answer

    def close(self) -> None:
        self._pipe.close()
        self._process.join(STOP_S)
        if self._process.is_alive():
            self._process.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _run(buses: list[tuple[str, str]], wires: dict[str, Wire], pipe: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the owner decides when we end
    try:
        hub = Hub(buses, wires)
    except ArmrigError as error:
        pipe.send(str(error))
        return

    def until_the_owner_is_gone() -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                question: Disturbance | None = pipe.recv()
                if question is not None:
                    hub.disturb(question)
                pipe.send(hub.traffic)
        hub.stop()

    real_time()
    with hub:
        pipe.send(hub.channels)
        threading.Thread(target=until_the_owner_is_gone, daemon=True).start()
        hub.run()
