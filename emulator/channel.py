"""Where a CAN hub is: `HOST:PORT` over TCP, or `unix:PATH`."""

import socket
from typing import NamedTuple

from protocols.errors import ConfigError

UNIX = "unix:"
LARGEST_PORT = 65535


class Channel(NamedTuple):
    """Address of a hub as the socket module takes it.

    Attributes:
        family: `AF_INET`, `AF_INET6` or `AF_UNIX`.
        address: (host, port), or the path of a unix socket.
    """

    family: socket.AddressFamily
    address: tuple[str, int] | str

    def __str__(self) -> str:
        if isinstance(self.address, str):
            return UNIX + self.address
        host, port = self.address
        return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def parse(text: str) -> Channel:
    """Channel of a rig file's `channel` key.

    Raises:
        ConfigError: Neither form.
    """
    if text.startswith(UNIX) and len(text) > len(UNIX):
        return Channel(socket.AF_UNIX, text.removeprefix(UNIX))
    host, _, port = text.rpartition(":")
    if not host or not (port.isascii() and port.isdigit()) or int(port) > LARGEST_PORT:
        raise ConfigError(
            f"channel {text!r} is no address of a CAN hub: write HOST:PORT with a port up to {LARGEST_PORT},"
            f" such as 127.0.0.1:29536, or unix:PATH."
        )
    host = host.removeprefix("[").removesuffix("]")
    return Channel(socket.AF_INET6 if ":" in host else socket.AF_INET, (host, int(port)))
