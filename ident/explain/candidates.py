"""Hypotheses with their grids as columns that `gram.Stage` can score."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ident.explain.drives import DRIVES
from ident.explain.friction import FRICTION
from ident.explain.gram import Stage
from ident.explain.hypothesis import Hypothesis, Theta
from ident.explain.rivals import RIVALS, Rival
from ident.explain.scene import Scene
from ident.explain.structure import STRUCTURE
from ident.explain.transmission import TRANSMISSION

Array = NDArray[np.float64]
Rows = dict[int, Array]

HYPOTHESES: tuple[Hypothesis, ...] = (*FRICTION, *TRANSMISSION, *DRIVES, *STRUCTURE)
REFINEMENTS = (1.0, 0.5, 0.25)  # steps of the local search over theta


@dataclass(frozen=True)
class Candidate:
    """One hypothesis on one joint (or on the arm) at one point of its grid.

    Attributes:
        joint: Whose grid it comes from; of the whole arm's effects, the first.
    """

    hypothesis: Hypothesis
    joint: int
    theta: Theta

    @property
    def key(self) -> tuple[str, tuple[int, ...]]:
        """Effect and joints: what a finding says."""
        return str(self.hypothesis.effect), self.joints

    @property
    def joints(self) -> tuple[int, ...]:
        if not self.hypothesis.whole:
            return (self.joint,)
        other = int(self.theta.get("other", 0.0))
        return (other - 1, self.joint) if other else ()

    @property
    def named(self) -> bool:
        return not isinstance(self.hypothesis, Rival)


@dataclass(frozen=True)
class Ranked:
    """A scored candidate.

    Attributes:
        gain: With everything that it costs [nats].
        held_out: The part from motion held out.
        c, std: Coefficients and standard deviations at noise level, shape (m,).
        columns: Weighted rows by joint, shape (n_j, m).
    """

    candidate: Candidate
    gain: float
    held_out: float
    c: Array
    std: Array
    columns: Rows = field(repr=False)


@dataclass(frozen=True)
class Batch:
    """Candidates of one hypothesis and joint; columns by joint, shape (n_j, G, m)."""

    candidates: list[Candidate]
    columns: Rows


def rows_of(scene: Scene, hypothesis: Hypothesis, joint: int, thetas: Sequence[Theta]) -> Rows:
    """Weighted rows of a hypothesis at several points, by joint, shape (n_j, G, m)."""
    parts = [[hypothesis.columns(scene, view, joint, theta) for theta in thetas] for view in scene.views]
    if not hypothesis.whole:
        return {joint: scene.rows_of(joint, [np.stack(p, axis=1) for p in parts])}
    out = {}
    for j in range(scene.joints):
        columns = [np.stack([c[j] for c in p], axis=1) for p in parts]
        if any(c.any() for c in columns):
            out[j] = scene.rows_of(j, columns)
    return out


def batch(scene: Scene, hypothesis: Hypothesis, joint: int, thetas: Sequence[Theta]) -> Batch | None:
    if not thetas:
        return None
    columns = rows_of(scene, hypothesis, joint, thetas)
    columns = {j: np.nan_to_num(c) for j, c in columns.items() if c.any()}
    if not columns:
        return None
    return Batch([Candidate(hypothesis, joint, t) for t in thetas], columns)


def batches(
    scene: Scene, joints: Iterable[int], hypotheses: Iterable[Hypothesis] = (*HYPOTHESES, *RIVALS)
) -> list[Batch]:
    """Every candidate, by hypothesis and joint."""
    wanted = list(joints)
    found = [batch(scene, h, j, list(h.grid(scene, j))) for h in hypotheses for j in wanted]
    return [b for b in found if b is not None]


def gains(scene: Scene, stage: Stage, b: Batch) -> tuple[Array, Array, Array, Array]:
    """Gain and held-out gain, shape (G, D); coefficients (G, m, D) and their deviations (G, m).

    What physics forbids has a gain of minus infinity.
    """
    scores = stage.score(b.columns)
    gain = scores.gain - b.candidates[0].hypothesis.complexity
    for g, candidate in enumerate(b.candidates):
        ok = candidate.hypothesis.plausible(scene, candidate.joint, candidate.theta, scores.c[g])
        gain[g, ~ok] = -np.inf
    return gain, scores.held_out, scores.c, scores.std


def best_of(scene: Scene, stage: Stage, b: Batch) -> tuple[Ranked, Array]:
    """The best candidate of a batch for the measured torque, and the best gain for every torque vector, shape (D,)."""
    gain, held_out, c, std = gains(scene, stage, b)
    g = int(np.argmax(gain[:, 0]))
    chosen = Ranked(
        b.candidates[g],
        float(gain[g, 0]),
        float(held_out[g, 0]),
        c[g, :, 0],
        std[g],
        {j: columns[:, g] for j, columns in b.columns.items()},
    )
    return chosen, gain.max(axis=0)


def refined(scene: Scene, stage: Stage, start: Ranked) -> Ranked:
    """Local search over the nonlinear parameters."""
    best = start
    for step in REFINEMENTS:
        for _ in range(2):
            c = best.candidate
            b = batch(scene, c.hypothesis, c.joint, c.hypothesis.near(scene, c.joint, c.theta, step))
            if b is None:
                return best
            tried, _unused = best_of(scene, stage, b)
            if tried.gain <= best.gain:
                break
            best = tried
    return best
