"""What `explain --json` prints: keys as the command line promises them, and some more."""

import math
from typing import Any, Literal

import msgspec
import numpy as np

from protocols.errors import ConfigError

Verdict = Literal["explained", "partly", "nothing-missing", "unlisted", "undecidable"]
Pair = tuple[float | None, float | None]


class Curve(msgspec.Struct, frozen=True):
    """A function drawn from data with its 95 % band; all four lists have one length.

    Attributes:
        over: What x is, with its unit.
        y, low, high: Torque [N·m, or N].
    """

    over: str
    x: list[float]
    y: list[float]
    low: list[float]
    high: list[float]


class Cell(msgspec.Struct, frozen=True):
    """One square of the residual map.

    Attributes:
        share_percent: Of the joint's excess torque that this regime variable organises.
        odd: The excess changes its sign with the direction of motion.
    """

    regime: str
    share_percent: float
    odd: bool


class Located(msgspec.Struct, frozen=True, kw_only=True):
    """Where a joint's torque is not explained by the refitted base model.

    Attributes:
        excess_ratio: Residual power over noise power; 1 is a perfect model.
        unexplained_percent: Share of the residual power that is not noise.
        regime: What organises the excess best.
        band_Hz: Frequencies that hold most of it.
        time_s: Where in the session it is largest: start and end of the worst second.
        map: Every regime that was looked at.
        sentence: All of it in words.
    """

    joint: str
    excess_ratio: float
    unexplained_percent: float
    regime: str
    band_Hz: tuple[float, float]
    time_s: tuple[float, float]
    sentence: str
    map: list[Cell] = []


class Parameter(msgspec.Struct, frozen=True):
    """One parameter of an effect.

    Attributes:
        std: With the spread over the functional forms that fit about as well.
        low, high: 95 % interval.
    """

    name: str
    value: float
    std: float
    unit: str
    low: float | None = None
    high: float | None = None


class Rival(msgspec.Struct, frozen=True):
    """Another explanation of the same excess and how well it did."""

    effect: str
    joints: list[str]
    gain_nats: float


class Finding(msgspec.Struct, frozen=True, kw_only=True):
    """One effect that was left out of the model.

    Attributes:
        group: Effects that these recordings can hardly tell apart; judge its probability first.
        because: Reasons in words.
        cost_Nm: Root mean square of its torque on the recordings, per joint of `joints`.
        curve: The effect as a function, where it is one of a single variable.
        time_s: Of an event; None for effects that are always there.
    """

    effect: str
    group: str
    joints: list[str]
    probability: float
    group_probability: float
    parameters: list[Parameter]
    gain_nats: float
    rivals: list[Rival]
    because: str
    cost_Nm: list[float] = []
    curve: Curve | None = None
    time_s: tuple[float, float] | None = None


class Unexplained(msgspec.Struct, frozen=True, kw_only=True):
    """What remains after all findings.

    Attributes:
        percent: Of the joint's residual power.
        organiser: The variable that orders it.
        form: In words, for physics that has no name here.
    """

    joint: str
    percent: float
    organiser: str
    form: str
    curve: Curve | None = None


class Levels(msgspec.Struct, frozen=True):
    """Relative torque error [%] of three models on the same rows.

    Attributes:
        prior: The simulator with the parameters of the robot file.
        refitted: The same structure with parameters fitted to the recordings.
        explained: With the physics found.
        per_joint: The last two per joint.
    """

    prior: float | None
    refitted: float | None
    explained: float | None
    per_joint: list[Pair]


class TrainUnseen(msgspec.Struct, frozen=True):
    """Before and after (refitted base, with the physics found); None where it could not be computed."""

    train: Pair | None
    unseen: Pair | None


class Unseen(msgspec.Struct, frozen=True):
    """Before and after on unseen motion."""

    unseen: Pair | None


class BeforeAfter(msgspec.Struct, frozen=True):
    """The improvement.

    Attributes:
        torque_error_percent: As inverse dynamics, all rows.
        position_error: Closed-loop simulation minus recording, root mean square, largest of the joints [rad or m].
        excess_ratio: Residual power over noise power, mean of the joints.
        levels: Three models on unseen motion, or on the recordings where none was kept back.
        simulated_torque_error_percent: Torque of the closed-loop simulation against the recording.
    """

    torque_error_percent: TrainUnseen
    position_error: Unseen
    excess_ratio: Unseen
    levels: Levels
    simulated_torque_error_percent: Unseen = Unseen(None)


class Experiment(msgspec.Struct, frozen=True):
    """A recording worth making.

    Attributes:
        resolves: The question it answers.
        expected_nats: Evidence that it would give between the two best answers of that question.
    """

    motion: str
    resolves: str
    expected_nats: float


class Power(msgspec.Struct, frozen=True):
    """Smallest effect that these recordings would have shown, so that silence says something.

    Attributes:
        torque_Nm: Root mean square of the effect's torque.
        smallest: The same as a parameter, with its name and unit; None where the joint could not show it at all.
    """

    effect: str
    joint: str
    torque_Nm: float | None
    smallest: float | None
    parameter: str


class Explanation(msgspec.Struct, frozen=True, kw_only=True):
    """The answer.

    Attributes:
        noise_floor_Nm: Torque noise per joint in the band that is judged, one period.
        summary: One sentence for a person in a hurry.
        threshold_nats: A gain below this happens by chance in 1 of 100 healthy recordings like these.
        healthy_ratio: Excess ratio per joint that 99 of 100 healthy recordings stay below.
    """

    robot: str
    runs: list[str]
    joints: list[str]
    noise_floor_Nm: list[float]
    located: list[Located]
    findings: list[Finding]
    unexplained: list[Unexplained]
    before_after: BeforeAfter
    next_experiments: list[Experiment]
    verdict: Verdict
    summary: str
    notes: list[str]
    power: list[Power] = []
    threshold_nats: float = 0.0
    healthy_ratio: list[float] = []
    seconds: float = 0.0


def to_json(explanation: Explanation) -> bytes:
    """One object; ends with a newline."""
    return msgspec.json.format(msgspec.json.encode(explanation, enc_hook=_plain), indent=2) + b"\n"


def _plain(value: Any) -> Any:
    """numpy's scalars as Python's; they compare alike but msgspec knows only the latter."""
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"{type(value).__name__} has no JSON form")


def from_json(text: bytes) -> Explanation:
    """Inverse of `to_json`.

    Raises:
        ConfigError: Not such a text.
    """
    try:
        return msgspec.json.decode(text, type=Explanation)
    except msgspec.DecodeError as error:
        raise ConfigError(f"Not the JSON of an explanation: {error}.") from error


def finite(value: float) -> float | None:
    """JSON has no NaN or infinity."""
    return float(value) if math.isfinite(value) else None
