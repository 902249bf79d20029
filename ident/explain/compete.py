"""Which effects explain the excess: forward selection with look-ahead, then backward and swap steps."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ident.explain import candidates
from ident.explain.candidates import Batch, Candidate, Ranked
from ident.explain.gram import Stage
from ident.explain.scene import Scene

Array = NDArray[np.float64]

DRAWS = 40  # simulated healthy recordings
LEVEL = 0.99  # of them stay below the threshold
LEAST_NATS = 10.0  # threshold at least: model errors at reversals are not in the simulated recordings
CHAIN = 0.04  # share of the gain explained so far that one more effect must bring: forms are never exact
CHAIN_RIVAL = 0.2  # the same for a rival without physics: it mends the form of what was named
MOST = 5  # effects on one joint
ABSTAIN_RATIO, ABSTAIN_NATS = 1.25, 6.0  # by which a rival without physics must win
LOOK_AHEAD = 6  # effects that are tried as the first of a pair
WIDE = 1e-6  # precision of an accepted effect's coefficient against its own columns


@dataclass(frozen=True)
class Null:
    """What healthy recordings like these give.

    Attributes:
        named, rival: Gain that the best effect, or rival, stays below in `LEVEL` of them.
        ratio: Excess ratio per joint that they stay below, shape (J,).
    """

    named: float
    rival: float
    ratio: Array


@dataclass(frozen=True)
class Outcome:
    """The result of the competition.

    Attributes:
        accepted: Effects in the order of their acceptance, at their final parameters.
        scans: For each of them, the best candidate of every effect and joint with the others accepted.
        unlisted: Rival without physics that beat every effect; None if none did.
        null: Thresholds.
        stage: With all accepted effects.
        first: The base model alone.
    """

    accepted: list[Ranked]
    scans: list[list[Ranked]]
    unlisted: Ranked | None
    null: Null
    stage: Stage
    first: Stage
    tried: list[Ranked] = field(default_factory=list)


class Competition:
    """Candidates of one scene; their columns are made once.

    Args:
        extra: Batches made elsewhere, such as the orders of a ripple scan.
    """

    def __init__(self, scene: Scene, joints: Sequence[int], extra: Sequence[Batch] = (), seed: int = 1) -> None:
        self.scene = scene
        self.batches = [*candidates.batches(scene, joints), *extra]
        self._rng = np.random.default_rng(seed)
        self.first = self.stage([], draws=DRAWS)
        self.opening, best = self._scan(self.first)
        named = np.array([c.candidate.named for c in self.opening])
        self.null = Null(
            max(LEAST_NATS, _upper(best[named, 1:].max(axis=0))),
            max(LEAST_NATS, _upper(best[~named, 1:].max(axis=0))) if (~named).any() else np.inf,
            self._healthy_ratio(),
        )

    def stage(self, accepted: Sequence[Ranked], draws: int = 0) -> Stage:
        """Base model with accepted effects; simulated healthy torque beside the measured one."""
        scene = self.scene
        W, precision = list(scene.W), np.ones(scene.W[0].shape[1])
        for a in accepted:
            m = len(a.c)
            blocks = [a.columns.get(j, np.zeros((len(W[j]), m))) for j in range(len(W))]
            size = np.maximum(sum((block**2).sum(axis=0) for block in blocks), 1e-12)
            W = [np.column_stack([w, block]) for w, block in zip(W, blocks, strict=True)]
            precision = np.concatenate([precision, WIDE * size])
        # healthy machines differ from their robot file by what its 1-sigma admit
        believed = self._rng.normal(size=(scene.W[0].shape[1], draws))
        Y = []
        for j, y in enumerate(scene.y):
            live = scene.weight[j] > 0
            healthy = scene.W[j] @ believed + self._rng.normal(size=(len(y), draws)) * live[:, None]
            Y.append(np.column_stack([y, healthy]))
        counted = [w > 0 for w in scene.weight]
        return Stage(W, Y, scene.fold, counted, scene.independent, precision)

    def _scan(self, stage: Stage) -> tuple[list[Ranked], Array]:
        """Best candidate of every batch, and the best gain for every torque vector, shape (batches, D)."""
        out = [candidates.best_of(self.scene, stage, b) for b in self.batches]
        return [ranked for ranked, _ in out], np.array([gain for _, gain in out])

    def scan(self, stage: Stage, joints: set[int] | None = None) -> list[Ranked]:
        """Best candidate of every effect and joint, best first; of some joints and the whole arm only, or of all."""
        wanted = [b for b in self.batches if joints is None or _touches(b.candidates[0], joints)]
        return _merged([candidates.best_of(self.scene, stage, b)[0] for b in wanted])

    def run(self) -> Outcome:
        """The whole selection."""
        accepted: list[Ranked] = []
        unlisted: Ranked | None = None
        ranking = _merged(self.opening)
        J = self.scene.joints
        explained = np.zeros(J)
        while len(accepted) < MOST + 2 * (J - 1):
            stage = self.stage(accepted)
            if accepted:  # what other joints have to gain hardly changed
                changed = set(accepted[-1].candidate.joints) or set(range(J))
                others = [r for r in ranking if not _touches(r.candidate, changed)]
                ranking = _merged([*self.scan(stage, changed), *others])
            crowded = {j for j in range(J) if sum(j in a.candidate.joints for a in accepted) >= MOST}
            open_ = [r for r in ranking if not set(r.candidate.joints) & crowded and self._enough(r, explained)]
            named, rival = _split(open_)
            best = candidates.refined(self.scene, stage, named[0]) if named else None
            if rival and self._abstains(rival[0], ranking, stage):
                pair = self._pair(accepted, _split(ranking)[0], rival[0])
                if pair is None:
                    unlisted = rival[0]
                    break
                best = pair
            if best is None or best.gain < self.null.named:
                break
            accepted.append(best)
            for j in best.candidate.joints or range(J):
                explained[j] += best.gain
        accepted = self._swapped(self._backward(accepted))
        scans = [self._rivals_of(accepted, i) for i in range(len(accepted))]
        return Outcome(accepted, scans, unlisted, self.null, self.stage(accepted), self.first, ranking)

    def _rivals_of(self, accepted: list[Ranked], i: int) -> list[Ranked]:
        joints = set(accepted[i].candidate.joints) or None
        return self.scan(self.stage(accepted[:i] + accepted[i + 1 :]), joints)

    def _enough(self, r: Ranked, explained: Array) -> bool:
        """Above what chance gives, and not a mere correction of the form of what was accepted on the joint before."""
        before = max((explained[j] for j in r.candidate.joints), default=float(explained.max(initial=0.0)))
        least = self.null.named if r.candidate.named else self.null.rival
        chain = CHAIN if r.candidate.named else CHAIN_RIVAL
        return bool(r.gain >= max(0.7 * least if r.candidate.named else least, chain * before))

    def _abstains(self, rival: Ranked, ranking: Sequence[Ranked], stage: Stage) -> bool:
        """A rival beats every named effect on its joint (and of the whole arm), refined."""
        named = [r for r in ranking if r.candidate.named and _touches(r.candidate, set(rival.candidate.joints))]
        best = max((candidates.refined(self.scene, stage, r).gain for r in named[:2]), default=0.0)
        return rival.gain > ABSTAIN_RATIO * max(best, 0.0) + ABSTAIN_NATS

    def _pair(self, accepted: list[Ranked], named: Sequence[Ranked], rival: Ranked) -> Ranked | None:
        """First of two effects that together do as well as the rival; None if no two do."""
        best: tuple[float, Ranked] | None = None
        where = set(rival.candidate.joints)
        able = [r for r in named if r.gain > 0.3 * self.null.named and _touches(r.candidate, where)]
        for first in able[:LOOK_AHEAD]:
            sharp = candidates.refined(self.scene, self.stage(accepted), first)
            stage = self.stage([*accepted, sharp])
            second = _split(self.scan(stage, where))[0][0]
            if second.gain < self.null.named:
                continue
            total = sharp.gain + second.gain
            if best is None or total > best[0]:
                best = total, sharp
        if best is None or best[0] * ABSTAIN_RATIO + ABSTAIN_NATS < rival.gain:
            return None
        return best[1]

    def _backward(self, accepted: list[Ranked]) -> list[Ranked]:
        """Without effects that the others made unnecessary; each at its parameters beside the others."""
        kept = list(accepted)
        changed = len(kept) > 1
        while changed:
            changed = False
            for i, one in enumerate(kept):
                others = kept[:i] + kept[i + 1 :]
                stage = self.stage(others)
                again = candidates.refined(self.scene, stage, self._rescored(stage, one))
                if again.gain < self.null.named:
                    kept, changed = others, len(others) > 1
                    break
                kept[i] = again
        return kept

    def _swapped(self, accepted: list[Ranked]) -> list[Ranked]:
        """Each effect against all others in its place."""
        kept = list(accepted)
        if len(kept) < 2:
            return kept
        for i in range(len(kept)):
            stage = self.stage(kept[:i] + kept[i + 1 :])
            here = self._rescored(stage, kept[i])
            named = _split(self.scan(stage, set(here.candidate.joints) or None))[0]
            rival = candidates.refined(self.scene, stage, named[0])
            if rival.candidate.key != here.candidate.key and rival.gain > here.gain + 2.0:
                kept[i] = rival
        return kept

    def _rescored(self, stage: Stage, one: Ranked) -> Ranked:
        c = one.candidate
        columns = {j: rows[:, None, :] for j, rows in one.columns.items()}
        return candidates.best_of(self.scene, stage, Batch([Candidate(c.hypothesis, c.joint, c.theta)], columns))[0]

    def _healthy_ratio(self) -> Array:
        """Excess ratio that simulated healthy recordings stay below, per joint."""
        out = []
        for j, weight in enumerate(self.scene.weight):
            rows = max(1, int((weight > 0).sum()))
            ratio = (self.first.residual(j)[:, 1:] ** 2).sum(axis=0) / rows
            out.append(float(ratio.mean() + 3 * ratio.std()) if weight.any() else 1.0)
        return np.array(out)


def _touches(candidate: Candidate, joints: set[int]) -> bool:
    """Of one of the joints, or of the whole arm."""
    return candidate.hypothesis.whole or bool(set(candidate.joints) & joints)


def excess_ratio(scene: Scene, stage: Stage) -> Array:
    """Residual power over noise power of every joint, shape (J,); NaN for joints that stand."""
    out = []
    for j, weight in enumerate(scene.weight):
        live = weight > 0
        out.append(float(np.mean(stage.residual(j)[live, 0] ** 2)) if live.any() else np.nan)
    return np.array(out)


def _merged(ranked: Sequence[Ranked]) -> list[Ranked]:
    """The best of every effect and joint, best first."""
    best: dict[tuple[str, ...], Ranked] = {}
    for r in ranked:
        kind = type(r.candidate.hypothesis).__name__ if not r.candidate.named else ""
        key = (*map(str, r.candidate.key), kind)
        if key not in best or r.gain > best[key].gain:
            best[key] = r
    return sorted(best.values(), key=lambda r: -r.gain)


def _split(ranking: Sequence[Ranked]) -> tuple[list[Ranked], list[Ranked]]:
    """Named effects and rivals."""
    return [r for r in ranking if r.candidate.named], [r for r in ranking if not r.candidate.named]


def _upper(best: Array) -> float:
    """Level of a Gumbel distribution fitted to maxima by moments."""
    finite = best[np.isfinite(best)]
    if finite.size < 5:
        return LEAST_NATS
    scale = float(finite.std()) * np.sqrt(6) / np.pi
    return float(finite.mean() - 0.5772 * scale - scale * np.log(-np.log(LEVEL)))
