"""The `armrig` command: the one place that knows all four parts."""


def main() -> None:
    """Entry point."""
