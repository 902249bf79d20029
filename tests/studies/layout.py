"""Layout of the TOML files that the studies write."""

import re


def one_line_arrays(text: str) -> str:
    """Arrays of numbers on one line each, as people write them; the writer puts every number on its own."""
    return re.sub(r"\[[^\[\]A-Za-df-z\"]*\]", _joined, text)


def _joined(numbers: re.Match[str]) -> str:
    return "[" + ", ".join(numbers[0].strip("[]").replace(",", " ").split()) + "]"
