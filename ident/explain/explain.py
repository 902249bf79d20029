"""From recordings to the answer: the one place that puts the steps in order.

Transient and dwell, asynchronous tests, base refit with its prior, location, competition, backward and swap, unseen
motion, closed loop, answer. What an effect is stays in the hypotheses.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from ident.base import base_parameters
from ident.explain import (
    asynchronous,
    judge,
    location,
    loop,
    motion,
    power,
    ripple,
    verdict,
)
from ident.explain import (
    findings as answers,
)
from ident.explain import (
    scene as scenes,
)
from ident.explain.candidates import Ranked
from ident.explain.compete import Competition, Outcome, excess_ratio
from ident.explain.contract import BeforeAfter, Explanation, Finding, Located, Pair, TrainUnseen, Unseen, finite
from ident.explain.judge import Model3
from ident.explain.motion import Motion, Run
from ident.explain.prior import Prior
from ident.explain.scene import Scene
from ident.model import Model
from ident.writeback import identified_robot
from protocols.clock import Clock, RealClock
from protocols.effectparams import EFFECT_KINDS
from protocols.effects import Effect
from protocols.errors import IdentificationError
from protocols.robot import EffectEntry, Robot

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

LEAST_SPEED = 2e-3  # of a joint's largest speed; slower motion is a standstill with an encoder's noise
REVERSALS = 2  # of a joint that friction can be seen on
HEALTHY_MARGIN = 1.5  # on the simulated null of the excess ratio: regressor noise, grazing reversals


@dataclass(frozen=True)
class Answer:
    """An explanation with what reports draw from.

    Attributes:
        explanation: What `--json` prints.
        robot: The robot file with refitted parameters and an entry for each effect.
        scene, competition, outcome: Everything behind it.
        models: Robot file, refitted, explained.
    """

    explanation: Explanation
    robot: Robot
    scene: Scene
    competition: Competition
    outcome: Outcome
    models: Model3


def explain(
    runs: Sequence[Run],
    robot: Robot,
    validation: Sequence[Run] = (),
    *,
    clock: Clock | None = None,
    progress: Progress = lambda fraction, stage: None,
    seed: int = 1,
) -> Answer:
    """What physics the robot file leaves out.

    Args:
        validation: Recordings of motion that the search never sees.
        seed: Of the simulated healthy recordings.

    Raises:
        DataError: Unusable recordings.
        IdentificationError: No joint moves enough to say anything.
    """
    clock = clock or RealClock()
    started = clock.now_ns()
    progress(0.0, "recordings")
    model = Model.of(robot)
    prior = Prior.of(model)
    moves = motion.motions(runs, robot.joint_names)
    notes = motion.clipped([*runs, *validation])
    active = _excited(moves, robot, notes)
    progress(0.1, "base model")
    scene = scenes.build(model, prior, moves)
    _remarks(scene, runs, notes)
    progress(0.3, "events and lines")
    events, lines = asynchronous.events(scene), asynchronous.lines(scene)
    if events:
        asynchronous.masked(scene, events)
        scene.refit()
    orders = {j: ripple.orders(scene, j) for j in active}
    progress(0.4, "hypotheses")
    extra = [b for j in active for b in ripple.batches(scene, j, orders[j])]
    competition = Competition(scene, active, extra, seed)
    progress(0.6, "competition")
    outcome = competition.run()
    progress(0.8, "judgement")
    models = Model3.of(scene, outcome.first.phi[:, 0], outcome.stage.phi[:, 0], _refreshed(scene, outcome))
    found = [
        *(answers.of_event(scene, e) for e in events),
        *(answers.of_line(scene, line) for line in lines),
        *answers.findings(competition, outcome),
    ]
    ratio, after = excess_ratio(scene, outcome.first), excess_ratio(scene, outcome.stage)
    healthy = np.maximum(outcome.null.ratio, 1.0) * HEALTHY_MARGIN
    left = answers.unexplained(competition, outcome, HEALTHY_MARGIN)
    before_after = _before_after(models, moves, runs, validation, notes)
    ruling = verdict.rule(scene, found, left, ratio, after, healthy, before_after, outcome)
    progress(0.95, "power")
    located = [location.locate(scene, outcome.first, j, float(ratio[j])) for j in active if ratio[j] > healthy[j]]
    pairs = list(zip(outcome.accepted, outcome.scans, strict=True))
    explanation = Explanation(
        robot=robot.name,
        runs=[run.signals.source for run in runs],
        joints=robot.joint_names,
        noise_floor_Nm=np.sqrt(scene.floor).tolist(),
        located=_worst_first(located),
        findings=found if ruling.trust else [],
        unexplained=left,
        before_after=before_after,
        next_experiments=power.next_experiments(scene, pairs, outcome.unlisted, outcome.null.named),
        verdict=ruling.verdict,
        summary=ruling.summary,
        notes=[*notes, *ruling.notes],
        power=power.power(competition),
        threshold_nats=outcome.null.named,
        healthy_ratio=healthy.tolist(),
        seconds=(clock.now_ns() - started) * 1e-9,
    )
    progress(1.0, "done")
    return Answer(explanation, _written(robot, model, models, found), scene, competition, outcome, models)


def _excited(moves: Sequence[Motion], robot: Robot, notes: list[str]) -> list[int]:
    """Joints that move enough to say something.

    Raises:
        IdentificationError: None does.
    """
    peak = np.max([np.abs(m.qd).max(axis=0) for m in moves], axis=0)
    span = np.max([np.ptp(m.q, axis=0) for m in moves], axis=0)
    active = []
    for j, joint in enumerate(robot.joint):
        turns = sum(_turns(m.qd[:, j], 0.05 * peak[j]) for m in moves)
        if peak[j] < LEAST_SPEED * joint.velocity_max_rad_s:
            notes.append(f"{joint.name} hardly moved ({span[j]:.2g} in position); nothing is said about it.")
        elif turns < REVERSALS:
            notes.append(
                f"{joint.name} reversed {turns} times; friction cannot be told from gravity and offsets. Nothing is"
                " said about it: record a motion that goes back and forth."
            )
        else:
            active.append(j)
    if not active:
        raise IdentificationError(
            f"No joint moves enough to explain anything: peak speeds are {', '.join(f'{v:.2g}' for v in peak)} rad/s"
            " (m/s). Record a motion in which the joints go back and forth at a fair part of their speed."
        )
    return active


def _turns(v: Array, least: float) -> int:
    """Changes of direction between speeds that count."""
    sign = np.sign(np.where(np.abs(v) > least, v, 0.0))
    sign = sign[sign != 0]
    return int((np.diff(sign) != 0).sum())


def _remarks(scene: Scene, runs: Sequence[Run], notes: list[str]) -> None:
    """What the reader should know about these recordings."""
    if not scene.floor_from_periods:
        notes.append(
            "No motion is repeated: the noise floor comes from the spectrum above the judged band, a weaker measure,"
            " and events are told from the rest of the motion only. Record at least three periods."
        )
    if len(scene.views) < 3:
        notes.append(
            f"{len(scene.views)} motion{'s' if len(scene.views) > 1 else ''}: pieces of it stand in for motion held"
            " out. Record at least three different ones."
        )
    if scene.prior.unknown:
        notes.append(
            f"The robot file states no 1-sigma for {', '.join(scene.prior.unknown)}: drive gain, payload and rotor"
            " inertia cannot be told apart there."
        )
    if all(run.temperature is None for run in runs):
        notes.append("No motor temperature was recorded; the session's time stands in for it.")
    notes += [note for run in runs for note in run.signals.notes if note not in notes]


def _refreshed(scene: Scene, outcome: Outcome) -> list[Ranked]:
    """Accepted effects with the coefficients of the joint fit."""
    found = answers.final_coefficients(scene, outcome)
    return [replace(a, c=c, std=std) for a, (c, std) in zip(outcome.accepted, found, strict=True)]


def _before_after(
    models: Model3, moves: Sequence[Motion], runs: Sequence[Run], validation: Sequence[Run], notes: list[str]
) -> BeforeAfter:
    """The improvement, on the recordings and on unseen motion."""
    names = models.scene.model.robot.joint_names
    train_views = models.views(motion.motions(runs, names, fold=False))
    train = judge.torque_errors(judge.residuals(models, train_views))
    if not validation:
        notes.append("No recording was kept back (--validate): before and after are of the recordings explained.")
        none = Unseen(None)
        return BeforeAfter(TrainUnseen((train.refitted, train.explained), None), none, none, train)
    views = models.views(motion.motions(validation, names, fold=False))
    unseen = judge.torque_errors(judge.residuals(models, views))
    folded = models.views(motion.motions(validation, names))
    ratios = judge.excess_ratios(models, folded, judge.residuals(models, folded))
    closed = loop.closed_loop(models, validation, views)
    position, simulated = Unseen(None), Unseen(None)
    if isinstance(closed, str):
        notes.append(closed)
    else:
        worst = int(np.argmax(closed.position[0]))
        position = Unseen((finite(closed.position[0, worst]), finite(closed.position[1, worst])))
        simulated = Unseen((finite(closed.torque_percent[0]), finite(closed.torque_percent[1])))
    pair: Pair = (unseen.refitted, unseen.explained)
    return BeforeAfter(
        TrainUnseen((train.refitted, train.explained), pair),
        position,
        Unseen((finite(ratios[0]), finite(ratios[1]))),
        unseen,
        simulated,
    )


def _worst_first(located: Sequence[Located]) -> list[Located]:
    return sorted(located, key=lambda place: -place.excess_ratio)


def _written(robot: Robot, model: Model, models: Model3, found: Sequence[Finding]) -> Robot:
    """The robot file with refitted parameters and the effects found."""
    base = base_parameters(model)
    fitted = identified_robot(model, base, base.B @ models.explained)
    entries: list[EffectEntry] = []
    for finding in found:
        entries += _entries(finding)
    return msgspec.structs.replace(fitted, effect=[*robot.effect, *entries])


def _entries(finding: Finding) -> list[EffectEntry]:
    """Entries of a robot file for a finding: one for each harmonic of a series, what the emulator does not know left
    out."""
    effect = msgspec.convert(finding.effect, Effect)
    if effect == "unlisted":
        return []
    where = finding.joints[-1] if finding.joints else ""
    known = {p.name: p for p in EFFECT_KINDS[effect].parameters}
    groups: dict[str, dict[str, float]] = {}
    for p in finding.parameters:
        name, _, number = p.name.partition("#")
        if name in known:
            low, high = known[name].low, known[name].high
            groups.setdefault(number, {})[name] = min(max(p.value, low), high)
    return [EffectEntry(effect=effect, joint=where, parameters=values) for values in groups.values()]
