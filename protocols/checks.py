"""One line of `armrig doctor`."""

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
