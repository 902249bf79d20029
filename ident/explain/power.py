"""The smallest effect that these recordings would have shown, and what to record to see more."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ident.explain.candidates import Ranked
from ident.explain.compete import Competition
from ident.explain.contract import Experiment, Power
from ident.explain.scene import Scene

Array = NDArray[np.float64]

LIBRARY = {
    "plateaus": "constant-speed plateaus in both directions, from the slowest to the fastest the joint does",
    "reversals": "slow reversals over ±3.5 % of the range, in several places",
    "standstill": "standstill with small dither at several poses, brakes released",
    "payload": "the same path with and without a known payload",
    "cold-warm": "the same motion cold and warm, 20 minutes apart",
    "micro-strokes": "triangular micro-strokes, from a tenth to five times the pre-sliding distance",
    "slow pass": "one slow pass over the whole range in both directions, then the same at three times the speed",
    "chirp": "a small multisine of 2 to 60 Hz on a constant speed that keeps friction in one direction",
    "preload": "the same multisine at three amplitudes, with gravity holding the gear on one flank",
    "single joints": "each joint alone, then both together in the same and in opposite directions",
    "static poses": "static poses approached from both sides",
    "known mass": "the same motion with a known mass at the last link",
    "dither": "a square wave of current at standstill",
    "static load": "increasing static loads, held",
    "tool off": "the same motion with the tool taken off",
    "turntable": "joint 1 through a full turn in steps, everything else standing",
    "accelerometer": "an accelerometer on the base during the same motion",
}


def power(competition: Competition) -> list[Power]:
    """Per effect and joint, by linear theory: gain = c² S / 2 reaches the threshold."""
    scene = competition.scene
    out: dict[tuple[str, str], Power] = {}
    for b in competition.batches:
        first = b.candidates[0]
        if not first.named or not first.joints:
            continue
        scores = competition.first.score(b.columns)
        for j in first.joints:
            if j not in b.columns:
                continue
            live = scene.weight[j] > 0
            rows = b.columns[j][live] / np.maximum(scene.weight[j][live], 1e-300)[:, None, None]
            rms = np.sqrt((rows**2).mean(axis=0))[:, 0]
            needed = np.sqrt(2 * competition.null.named) * scores.std[:, 0]
            size = needed * rms
            g = int(np.argmin(np.where(size > 0, size, np.inf)))
            if not np.isfinite(size[g]) or size[g] <= 0:
                continue
            h = first.hypothesis
            c = np.zeros(b.columns[j].shape[2])
            c[0] = needed[g]
            named = h.parameters(scene, first.joint, b.candidates[g].theta, c, np.zeros_like(c))[0]
            joint = scene.model.robot.joint[j].name
            key = (str(h.effect), joint)
            entry = Power(str(h.effect), joint, float(size[g]), abs(named.value), f"{named.unit} ({named.name})")
            seen = out.get(key)
            if seen is None or (seen.torque_Nm or np.inf) > size[g]:
                out[key] = entry
    return sorted(out.values(), key=lambda p: (p.joint, p.effect))


def next_experiments(
    scene: Scene, findings: Sequence[tuple[Ranked, Sequence[Ranked]]], unlisted: Ranked | None, threshold: float
) -> list[Experiment]:
    """Recordings that would tell the closest rivals apart, the most telling first.

    Expected evidence: the recordings at hand gave `margin` nats between the two; an experiment made for the question
    puts the part of the effect's torque that the base and the rival do not share into every one of its rows.
    """
    out: dict[str, Experiment] = {}
    for found, rivals in findings:
        close = [r for r in rivals if r.candidate.key != found.candidate.key and r.candidate.named][:2]
        for rival in close:
            margin = found.gain - max(rival.gain, 0.0)
            same = rival.candidate.hypothesis.group == found.candidate.hypothesis.group
            if margin > 3 * threshold and not same:
                continue
            where = _names(scene, found)
            question = f"{found.candidate.hypothesis.effect} or {rival.candidate.hypothesis.effect} on {where}"
            expected = _expected(scene, found, rival)
            for key in found.candidate.hypothesis.experiments[:1]:
                motion = f"{where}: {LIBRARY[key]}"
                known = out.get(motion)
                if known is None or known.expected_nats < expected:
                    out[motion] = Experiment(motion, question, float(expected))
    if unlisted is not None:
        where = _names(scene, unlisted)
        motion = f"{where}: {LIBRARY['slow pass']}"
        out[motion] = Experiment(motion, "what the unlisted torque depends on", float(unlisted.gain))
    return sorted(out.values(), key=lambda e: -e.expected_nats)


def _expected(scene: Scene, one: Ranked, other: Ranked) -> float:
    """Half the squared distance, in noise, of two effects' torques if each row showed both without the base's help."""
    total = 0.0
    for j in range(scene.joints):
        a = one.columns[j] @ one.c if j in one.columns else np.zeros(len(scene.y[j]))
        if j in other.columns:
            fit, *_ = np.linalg.lstsq(other.columns[j], a, rcond=None)
            a = a - other.columns[j] @ fit
        total += 0.5 * scene.independent * float(a @ a)
    return total


def _names(scene: Scene, ranked: Ranked) -> str:
    return ", ".join(scene.model.robot.joint[j].name for j in ranked.candidate.joints) or "whole arm"
