"""From signals to the answer: the one place that puts dataset, model, estimate, tests and validation in order."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from ident import contract
from ident.auxiliary import standard
from ident.base import Base, base_parameters
from ident.covariance import named
from ident.dataset import FILTER_HZ, Signals, prepare
from ident.estimate import Estimate
from ident.methods import METHODS
from ident.model import Model
from ident.observation import DECIMATE_TO_HZ, Observation, observe, relative_error
from ident.problem import Estimator, Problem
from ident.reduction import Reduction, reduce
from ident.simulation import closed_loop
from ident.statistics import statistics
from protocols.clock import Clock, RealClock
from protocols.errors import ArmrigError, ConfigError, DataError
from protocols.robot import Robot

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Settings:
    """How signals become rows.

    Attributes:
        filter_Hz: Cut-off of the zero-phase position filter.
        decimate_to_Hz: Rate of the rows.
        speed_threshold_rad_s: Slower rows are not used; None for a share of each joint's peak speed.
        offsets: Identify a constant torque per joint.
        covariance: Name of `ident.covariance`, for the methods that have a choice.
        simulate: Simulate the closed loop with every estimate; methods that simulate anyway always do.
    """

    filter_Hz: float = FILTER_HZ
    decimate_to_Hz: float = DECIMATE_TO_HZ
    speed_threshold_rad_s: float | None = None
    offsets: bool = True
    covariance: str = "hac"
    simulate: bool = False


DEFAULTS = Settings()


@dataclass(frozen=True)
class Identification:
    """One method's answer with everything a report needs.

    Attributes:
        result: What `--json` prints.
        unseen: Observations of the validation recordings.
    """

    result: contract.Result
    model: Model
    base: Base
    estimate: Estimate
    reduction: Reduction
    seen: list[Observation]
    unseen: list[Observation]
    truth: Mapping[str, float] = field(default_factory=dict)


def identify(
    runs: Sequence[Signals],
    robot: Robot,
    methods: Sequence[str] = ("wls",),
    validation: Sequence[Signals] = (),
    settings: Settings = DEFAULTS,
    truth: Mapping[str, float] | None = None,
    clock: Clock | None = None,
    progress: Progress = lambda fraction, stage: None,
) -> list[Identification]:
    """Identify a robot's base parameters.

    Args:
        methods: Keys of `ident.methods.METHODS`.
        validation: Motions not used to fit.
        truth: Base parameters known to the caller, shown beside the estimates and used for the noise floor only.
        progress: Told how far the work is, 0 to 1.

    Raises:
        ConfigError: Unknown method, no recordings, or the robot has other joints than a recording.
        DataError, IdentificationError: As `prepare`, `observe` and the method.
    """
    clock = clock or RealClock()
    _check(runs, validation, robot, methods)
    started = clock.now_ns()
    progress(0.0, "base parameters")
    model = Model.of(robot, offsets=settings.offsets)
    base = base_parameters(model)
    every = [*runs, *validation]
    datasets, observations = [], []
    for index, signals in enumerate(every):
        progress(0.1 + 0.6 * index / len(every), f"dataset and regressor of {signals.source}")
        datasets.append(prepare(signals, settings.filter_Hz))
        observations.append(observe(datasets[-1], model, base, settings.decimate_to_Hz, settings.speed_threshold_rad_s))
    seen, unseen = observations[: len(runs)], observations[len(runs) :]
    grid = settings.decimate_to_Hz, settings.speed_threshold_rad_s
    problem = Problem(model, base, runs, datasets[: len(runs)], seen, *grid)
    judged = Problem(model, base, validation, datasets[len(runs) :], unseen, *grid) if validation else problem
    recordings = [_run(s, "fit") for s in runs] + [_run(s, "validation") for s in validation]
    prepared_ns = clock.now_ns() - started
    out = []
    for index, method in enumerate(methods):
        progress(0.7 + 0.3 * index / len(methods), METHODS[method].name)
        begun = clock.now_ns()
        fitted = estimator(method, settings).fit(problem)
        reduction = reduce(fitted)
        seconds = (prepared_ns + clock.now_ns() - begun) * 1e-9
        simulation = _simulate(judged, fitted, asked=settings.simulate)
        result = _result(fitted, reduction, model, seen, unseen, truth or {}, seconds, recordings, simulation)
        out.append(Identification(result, model, base, fitted, reduction, seen, unseen, truth or {}))
    progress(1.0, "done")
    return out


def estimator(method: str, settings: Settings = DEFAULTS) -> Estimator:
    """The method of a name, with the covariance asked for where it has a choice.

    Raises:
        ConfigError: Unknown covariance.
    """
    found = METHODS[method]
    if settings.covariance == DEFAULTS.covariance or not hasattr(found, "covariance"):
        return found
    chosen: Estimator = replace(cast(Any, found), covariance=named(settings.covariance))  # a frozen dataclass
    return chosen


def truth_values(nominal: Robot, machine: Robot, settings: Settings = DEFAULTS) -> dict[str, float]:
    """Base parameters of the machine that an emulator runs, in the names the identification of `nominal` uses."""
    model = Model.of(nominal, offsets=settings.offsets)
    base = base_parameters(model)
    return dict(zip(base.names, (base.B @ model.theta(machine)).tolist(), strict=True))


def _check(runs: Sequence[Signals], validation: Sequence[Signals], robot: Robot, methods: Sequence[str]) -> None:
    unknown = [m for m in methods if m not in METHODS]
    if unknown or not methods:
        raise ConfigError(f"Method {', '.join(unknown) or '(none)'} is unknown; choose from {', '.join(METHODS)}.")
    if not runs:
        raise ConfigError("No recording to fit was given.")
    for signals in [*runs, *validation]:
        if signals.joints != robot.joint_names:
            raise DataError(
                f"{signals.source} has the joints {', '.join(signals.joints)}, but robot {robot.name} has"
                f" {', '.join(robot.joint_names)}. Give the robot file of the recording."
            )


def _run(signals: Signals, role: str) -> contract.Run:
    seconds = float(signals.t_s[-1] - signals.t_s[0])
    return contract.Run(signals.source, role, signals.verdict, seconds, signals.t_s.size, signals.sha256)


def _simulate(judged: Problem, fitted: Estimate, *, asked: bool) -> tuple[contract.Simulation | None, str]:
    """Closed loop with the estimate, on unseen recordings where there are any; or why there is none."""
    if not (asked or fitted.history):
        return None, "simulation: null, no closed-loop simulation was asked for."
    try:
        return closed_loop(judged, standard(judged.base, fitted.beta)), ""
    except ArmrigError as error:
        return None, f"simulation: null. {error}"


def _result(
    fitted: Estimate,
    reduction: Reduction,
    model: Model,
    seen: Sequence[Observation],
    unseen: Sequence[Observation],
    truth: Mapping[str, float],
    seconds: float,
    recordings: list[contract.Run],
    simulation: tuple[contract.Simulation | None, str],
) -> contract.Result:
    base = fitted.base
    prior = base.B @ model.theta(model.robot)
    relative = fitted.relative_std_percent
    parameters = [
        contract.Parameter(
            name=name,
            value=float(fitted.beta[i]),
            std=float(fitted.std[i]),
            rel_std_percent=contract.finite(relative[i]),
            unit=base.units[i],
            essential=bool(reduction.essential[i]),
            prior=float(prior[i]),
            truth=truth.get(name),
        )
        for i, name in enumerate(base.names)
    ]
    notes = [
        *fitted.notes,
        *(note for o in unseen for note in o.notes),
        *filter(None, [simulation[1]]),
        "physically_consistent: null, base parameters alone do not determine masses and inertias.",
    ]
    return contract.Result(
        method=fitted.method,
        robot=model.robot.name,
        runs=[o.source for o in seen],
        parameters=parameters,
        fit=fit_quality(seen, fitted, truth),
        validation=fit_quality(unseen, fitted, truth) if unseen else None,
        simulation=simulation[0],
        statistics=[*statistics(fitted, seen, reduction), *fitted.tests],
        iterations=fitted.iterations,
        converged=fitted.converged,
        condition_number=fitted.condition_scaled,
        condition_number_raw=fitted.condition,
        physically_consistent=None,
        seconds=seconds,
        covariance=fitted.covariance_name,
        relations=base.relations(),
        recordings=recordings,
        notes=list(dict.fromkeys(notes)),
        history=list(fitted.history),
    )


def fit_quality(observations: Sequence[Observation], fitted: Estimate, truth: Mapping[str, float]) -> contract.Fit:
    """Relative torque error over several recordings, and what the true parameters would leave."""
    total, per_joint = relative_error(observations, fitted.beta)
    floor = None
    if truth and all(name in truth for name in fitted.base.names):
        floor = relative_error(observations, np.array([truth[name] for name in fitted.base.names]))[0]
    return contract.Fit(
        relative_error_percent=total,
        per_joint_percent=[contract.finite(e) for e in per_joint],
        bandwidth_Hz=observations[0].bandwidth_Hz,
        rows=sum(o.rows for o in observations),
        noise_floor_percent=floor,
    )
