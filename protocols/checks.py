"""Lines of `armrig doctor` and `armrig bench`."""

import msgspec


class Check(msgspec.Struct, frozen=True):
    """What one look at the machine found.

    Attributes:
        name: What was looked at.
        ok: Whether everything works; False where something is missing that not everybody needs.
        detail: One sentence with numbers, and what to do.
    """

    name: str
    ok: bool
    detail: str


class Figure(msgspec.Struct, frozen=True):
    """What one benchmark measured, beside a peer that does the same work in the same run.

    Attributes:
        name: What was done.
        value, peer_value: In `unit`.
        peer: Who else did it.
        ratio: How many times better than the peer; what to quote, since it survives a busy machine.
    """

    name: str
    value: float
    unit: str
    peer: str
    peer_value: float
    ratio: float
