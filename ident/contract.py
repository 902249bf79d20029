"""What `identify --json` prints: keys as the command line promises them."""

import math
from typing import Any

import msgspec

from protocols.errors import ConfigError


class Parameter(msgspec.Struct, frozen=True):
    """One base parameter.

    Attributes:
        essential: Kept by the model reduction.
        prior: A-priori value from the robot file.
        truth: Where an emulator knows it, told by the caller; never found in a recording.
    """

    name: str
    value: float
    std: float
    rel_std_percent: float | None
    unit: str
    essential: bool
    prior: float | None
    truth: float | None = None


class Fit(msgspec.Struct, frozen=True):
    """How well torques are predicted.

    Attributes:
        noise_floor_percent: The same error with the true parameters, where the caller told them.
    """

    relative_error_percent: float
    per_joint_percent: list[float | None]
    bandwidth_Hz: float
    rows: int
    noise_floor_percent: float | None = None


class Run(msgspec.Struct, frozen=True):
    """One recording that was used.

    Attributes:
        role: `fit` or `validation`.
        verdict: Of the recorder: `LOSSLESS`, `GAPS(n)` or `UNVERIFIABLE`.
    """

    name: str
    role: str
    verdict: str
    seconds: float
    samples: int
    sha256: str


class Statistic(msgspec.Struct, frozen=True, omit_defaults=True):
    """One test; `not_applicable` gives the reason where there is no number."""

    name: str
    null: str
    statistic: float | None = None
    p_value: float | None = None
    not_applicable: str | None = None
    verdict: str = "undecidable"


class Simulation(msgspec.Struct, frozen=True):
    """Closed-loop simulation under the recorded control law against the recording, per joint.

    Attributes:
        position_error_percent: ||q - qs|| / ||q||; None for a joint that stays at zero.
        torque_error_percent: The same of torques, in the bandwidth of the fit.
        runs: Recordings simulated.
    """

    position_error_percent: list[float | None]
    torque_error_percent: list[float | None]
    runs: list[str] = []


class Iterate(msgspec.Struct, frozen=True):
    """One iteration of a method that simulates.

    Attributes:
        beta: Base parameters, in the order of the result.
        position_error_percent: ||q - qs|| / ||q|| of the simulation at them, per joint (Janot et al. 2014, Table 5).
        residual_norm: Of eq. (27) or of the output error; None at a start where it was not computed.
    """

    beta: list[float]
    position_error_percent: list[float]
    residual_norm: float | None


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """One method's answer.

    Attributes:
        runs: Names of the recordings fitted.
        relations: How standard parameters regroup into the base parameters.
        covariance: How the standard deviations were made.
        condition_number: Of W with its columns scaled to length 1; `condition_number_raw` of W itself.
        history: Iterations, the start first; empty for closed forms.
        physically_consistent: None: not examined (base parameters alone do not tell).
    """

    method: str
    robot: str
    runs: list[str]
    parameters: list[Parameter]
    fit: Fit
    validation: Fit | None
    simulation: Simulation | None
    statistics: list[Statistic]
    iterations: int
    converged: bool
    condition_number: float
    condition_number_raw: float
    physically_consistent: bool | None
    seconds: float
    covariance: str
    relations: list[str]
    recordings: list[Run]
    notes: list[str]
    history: list[Iterate] = []


def to_json(results: list[Result]) -> bytes:
    """One object, or a list of several; ends with a newline."""
    value: Any = results[0] if len(results) == 1 else results
    return msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n"


def from_json(text: bytes) -> list[Result]:
    """Inverse of `to_json`.

    Raises:
        ConfigError: Not such a text.
    """
    try:
        if text.lstrip().startswith(b"["):
            return msgspec.json.decode(text, type=list[Result])
        return [msgspec.json.decode(text, type=Result)]
    except msgspec.DecodeError as error:
        raise ConfigError(f"Not the JSON of an identification: {error}.") from error


def finite(value: float) -> float | None:
    """JSON has no NaN or infinity."""
    return float(value) if math.isfinite(value) else None
