"""The ruling: explained, partly, nothing missing, unlisted or undecidable, and one sentence that says it."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ident.explain.compete import Outcome
from ident.explain.contract import BeforeAfter, Finding, Unexplained, Verdict
from ident.explain.scene import Scene

Array = NDArray[np.float64]

ENOUGH = 0.7  # share of the excess that must be gone to call it explained
NO_TORQUE = 0.6  # share of a signal's variance left after all, from which on it is not a torque of this arm
MOVED = 3.0  # standard deviations by which refitted parameters left the prior: parameters wrong, structure right


@dataclass(frozen=True)
class Ruling:
    """Attributes:
    trust: The findings are fit to be shown.
    """

    verdict: Verdict
    summary: str
    notes: list[str] = field(default_factory=list)
    trust: bool = True


def rule(  # noqa: PLR0911  (one return per verdict)
    scene: Scene,
    found: Sequence[Finding],
    left: Sequence[Unexplained],
    before: Array,
    after: Array,
    healthy: Array,
    figures: BeforeAfter,
    outcome: Outcome,
) -> Ruling:
    """The ruling on one set of recordings."""
    strange = _not_a_torque(scene, outcome)
    if strange:
        return Ruling("undecidable", strange[0], strange, trust=False)
    moved = _parameters_moved(scene, figures)
    excess = np.nansum(np.maximum(before - 1, 0.0))
    gone = 1 - np.nansum(np.maximum(after - 1, 0.0)) / excess if excess > 0 else 1.0
    names = " and ".join(f"{f.effect} on {', '.join(f.joints) or 'the whole arm'}" for f in found)
    if outcome.unlisted is not None:
        shape = next((u for u in left if "no effect of the list" in u.form), None)
        words = f"{shape.joint}: {shape.form}" if shape else "something that no effect of the list reproduces"
        also = f" Besides: {names}." if found else ""
        return Ruling("unlisted", f"Physics without a name here, {words}.{also}", moved)
    if not found:
        if np.all((after <= healthy) | ~np.isfinite(after)):
            first = "The refitted model explains these recordings down to their noise floor."
            return Ruling("nothing-missing", f"{first} {moved[0]}" if moved else first, moved)
        worst = int(np.nanargmax(after / healthy))
        if after[worst] < 3 * healthy[worst]:
            return Ruling(
                "nothing-missing",
                "The residual is somewhat above the noise floor, but no effect and no shape predicts any of it.",
                moved,
            )
        return Ruling(
            "undecidable",
            f"{scene.model.robot.joint[worst].name} has {after[worst]:.3g} times its noise power, but no effect and no"
            " shape predicts it on motion held out. See what to record next.",
            moved,
        )
    if gone >= ENOUGH or np.all((after <= healthy) | ~np.isfinite(after)):
        return Ruling(
            "explained", f"Left out was {names}; with it {100 * min(gone, 1):.0f} % of the excess is gone.", moved
        )
    return Ruling(
        "partly", f"Left out was {names}; {100 * gone:.0f} % of the excess is gone, the rest is below.", moved
    )


def _not_a_torque(scene: Scene, outcome: Outcome) -> list[str]:
    """A sentence per joint whose signal cannot be a torque of this arm, or has the wrong sign or scale."""
    out = []
    theta = scene.prior.theta + scene.prior.sigma * outcome.stage.phi[: len(scene.prior.theta), 0]
    value = dict(zip(scene.model.names, theta, strict=True))
    for j, joint in enumerate(scene.model.robot.joint):
        live = scene.weight[j] > 0
        if not live.any():
            continue
        tau = np.concatenate([v.low(v.motion.tau_Nm)[:, j] for v in scene.views])[live]
        r = outcome.stage.residual(j)[live, 0] / scene.weight[j][live]
        share = float(np.var(r) / max(np.var(tau), 1e-300))
        sign = [np.concatenate([v.motion.qd[v.low.at, j] for v in scene.views])[live]]
        if value[f"Fv{j + 1}"] < 0 and value[f"Fc{j + 1}"] < 0 and float(np.mean(tau * sign[0])) < 0:
            out.append(
                f"{joint.name}: the torque signal brakes nothing, it drives against friction; its sign (or that of the"
                " gear) is wrong. Check the mapping of the recording."
            )
        elif share > NO_TORQUE:
            out.append(
                f"{joint.name}: {100 * share:.0f} % of the torque signal cannot be predicted from the motion at all; it"
                " may not be a torque (or current) of this joint. Check column, unit and time stamps."
            )
    return out


def _parameters_moved(scene: Scene, figures: BeforeAfter) -> list[str]:
    """ "Parameters wrong, structure right", where it is so."""
    theta, sigma = scene.prior.theta, scene.prior.sigma
    known = (sigma > 0) & ~np.isin(
        [int(n.lstrip("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz_")) - 1 for n in scene.model.names],
        [scene.model.robot.joint_names.index(name) for name in scene.prior.unknown],
    )
    far = [i for i in np.argsort(-np.abs(scene.phi)) if known[i] and abs(scene.phi[i]) > MOVED]
    levels = figures.levels
    if not far or levels.prior is None or levels.refitted is None or levels.prior < 2 * levels.refitted:
        return []
    shown = ", ".join(f"{scene.model.names[i]} from {theta[i]:.3g} to {scene.theta[i]:.3g}" for i in far[:4])
    return [
        f"Parameters of the robot file are off ({shown}): refitting alone brings the torque error from"
        f" {levels.prior:.1f} to {levels.refitted:.1f} %."
    ]
