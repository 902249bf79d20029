"""One error tree. Each class carries the exit code of the command line (ARCHITECTURE: 0 done, 1 bug, ...).

A message is one sentence or two: what happened, with numbers and units, and what to do about it.
"""


class ArmrigError(Exception):
    """Base of every error that is the user's, the data's or the peer's, never a bug.

    Attributes:
        exit_code: What the process returns when the error ends it.
    """

    exit_code = 1


class ConfigError(ArmrigError):
    """A file, flag or combination of settings cannot be used (exit code 2)."""

    exit_code = 2


class DataError(ArmrigError):
    """A recording is unusable for what was asked (exit code 3)."""

    exit_code = 3


class IdentificationError(ArmrigError):
    """The data are sound but the model is not identifiable, or an iteration did not converge (exit code 4)."""

    exit_code = 4


class PeerError(ArmrigError):
    """A bus, service or device could not be reached, or went away (exit code 5)."""

    exit_code = 5
