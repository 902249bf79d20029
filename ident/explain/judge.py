"""Before and after: torque of the three models on the same rows, seen or unseen."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.explain import rows
from ident.explain import scene as scenes
from ident.explain.candidates import Ranked
from ident.explain.contract import Levels, finite
from ident.explain.motion import Motion
from ident.explain.rows import Lowpass
from ident.explain.scene import Scene, View

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Model3:
    """The three models.

    Attributes:
        prior, refitted, explained: Standard parameters, shape (P,).
        effects: With their coefficients; part of the last model only.
    """

    scene: Scene
    prior: Array
    refitted: Array
    explained: Array
    effects: list[Ranked]

    @classmethod
    def of(cls, scene: Scene, first: Array, last: Array, effects: list[Ranked]) -> "Model3":
        """Models from base parameters in prior units before and after the effects."""
        prior = scene.prior
        p = len(prior.theta)
        return cls(
            scene, prior.theta, prior.theta + prior.sigma * first[:p], prior.theta + prior.sigma * last[:p], effects
        )

    def views(self, motions: Sequence[Motion]) -> list[View]:
        """Motions as the hypotheses saw those that they were fitted to."""
        s = self.scene
        return [
            scenes.view(
                s.model, m, Lowpass.of(m.samples, rows.factor(m.dt_s, s.joints), circular=m.circular), s.theta, s.soft
            )
            for m in motions
        ]

    def effect_torque(self, view: View, effect: Ranked) -> Array:
        """What one effect adds at the inner rate, shape (T, J)."""
        candidate = effect.candidate
        columns = candidate.hypothesis.columns(self.scene, view, candidate.joint, candidate.theta)
        out = np.zeros(view.motion.q.shape)
        if candidate.hypothesis.whole:
            out += (columns @ effect.c).T
        else:
            out[:, candidate.joint] = columns @ effect.c
        return out

    def extra_torque(self, view: View) -> Array:
        """What all effects add, shape (T, J)."""
        return np.asarray(sum((self.effect_torque(view, e) for e in self.effects), np.zeros(view.motion.q.shape)))


@dataclass(frozen=True)
class Residuals:
    """Rows of torque and of three residuals (prior, refitted, explained), shapes (J, N) and (3, J, N)."""

    torque: Array
    left: Array


def residuals(models: Model3, views: Sequence[View]) -> list[Residuals]:
    """Of every motion, on all of its rows."""
    out = []
    for view in views:
        W = scenes.regressor(models.scene.model, view.motion, models.scene.soft)
        extra = models.extra_torque(view)
        predicted = [(W @ theta).T for theta in (models.prior, models.refitted, models.explained)]
        predicted[2] = predicted[2] + extra
        tau = view.low(view.motion.tau_Nm)
        left = np.stack([(tau - view.low(p)).T for p in predicted])
        out.append(Residuals(tau.T, left))
    return out


def torque_errors(found: Sequence[Residuals]) -> Levels:
    """||residual|| / ||torque|| in percent over all rows."""
    torque = np.concatenate([r.torque for r in found], axis=1)
    left = np.concatenate([r.left for r in found], axis=2)
    whole = 100 * np.linalg.norm(left, axis=(1, 2)) / np.linalg.norm(torque)
    size = np.linalg.norm(torque, axis=1)
    each = 100 * np.divide(
        np.linalg.norm(left, axis=2), size, out=np.full(left.shape[:2], np.nan), where=size[None] > 0
    )
    pairs = [(finite(a), finite(b)) for a, b in zip(each[1], each[2], strict=True)]
    return Levels(finite(whole[0]), finite(whole[1]), finite(whole[2]), pairs)


def excess_ratios(models: Model3, views: Sequence[View], found: Sequence[Residuals]) -> Array:
    """Residual power over noise power of the last two models, mean over rows and joints that move, shape (2,)."""
    s = models.scene
    total, count = np.zeros(2), 0
    for view, r in zip(views, found, strict=True):
        standing = rows.standing(view.motion, view.low, s.peak)
        edge = rows.reversal(view.motion, view.low, s.soft)
        variance = s.floor / view.motion.periods + (rows.KAPPA * s.coulomb * edge) ** 2
        live = ~standing.T
        total += (r.left[1:] ** 2 / variance.T * live).sum(axis=(1, 2))
        count += int(live.sum())
    return total / max(count, 1)
