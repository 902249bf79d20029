"""Accepted effects as findings: how sure, which rivals, parameters with the spread over forms, a drawn curve."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ident.explain import candidates, location
from ident.explain.asynchronous import Event, Line
from ident.explain.candidates import Ranked
from ident.explain.compete import Competition, Outcome, excess_ratio
from ident.explain.contract import Curve, Finding, Parameter, Rival, Unexplained
from ident.explain.gram import Stage
from ident.explain.hypothesis import parameter
from ident.explain.rivals import Rival as AnyShape
from ident.explain.scene import Scene

Array = NDArray[np.float64]

TEMPERATURE_NATS = 2.0  # of P ~ exp(gain / this): from simulated concealed cases
FORMS_NATS = 3.0  # forms that fit within this are possible; parameters spread over them
SHOWN = 5  # rivals
CURVE_OF = {"speed": "speed", "position": "position", "load": "transmitted torque"}


def findings(competition: Competition, outcome: Outcome) -> list[Finding]:
    """One finding per accepted effect, in the order of their cost."""
    scene = competition.scene
    ratio = excess_ratio(scene, outcome.stage)
    coefficients = final_coefficients(scene, outcome)
    out = []
    for i, (accepted, every) in enumerate(zip(outcome.accepted, outcome.scans, strict=True)):
        others = outcome.accepted[:i] + outcome.accepted[i + 1 :]
        stage = competition.stage(others)
        scan = [r for r in every if _rivals(r, accepted)]
        c, std = coefficients[i]
        out.append(_finding(scene, stage, accepted, scan, c, std, ratio, outcome))
    return sorted(out, key=lambda f: -max(f.cost_Nm, default=0.0))


def final_coefficients(scene: Scene, outcome: Outcome) -> list[tuple[Array, Array]]:
    """Coefficients and standard deviations of all accepted effects, fitted together."""
    p = scene.W[0].shape[1]
    stage = outcome.stage
    covariance = stage.covariance()
    out, at = [], p
    for accepted in outcome.accepted:
        m = len(accepted.c)
        out.append((stage.phi[at : at + m, 0], np.sqrt(np.diag(covariance)[at : at + m])))
        at += m
    return out


def probabilities(found: Ranked, scan: Sequence[Ranked], threshold: float) -> tuple[float, float]:
    """Of the effect on its joints, and of its group there; nothing at all counts as a gain of the threshold."""
    best = {
        r.candidate.key + ((type(r.candidate.hypothesis).__name__,) if not r.candidate.named else ()): r for r in scan
    }
    best[found.candidate.key] = found
    gains = {key: r.gain for key, r in best.items() if np.isfinite(r.gain)}
    top = max([*gains.values(), threshold])
    weight = {key: float(np.exp((g - top) / TEMPERATURE_NATS)) for key, g in gains.items()}
    total = sum(weight.values()) + float(np.exp((threshold - top) / TEMPERATURE_NATS))
    group = sum(
        weight[key]
        for key, r in best.items()
        if key in weight
        and r.candidate.hypothesis.group == found.candidate.hypothesis.group
        and (set(r.candidate.joints) & set(found.candidate.joints) or not r.candidate.joints)
    )
    return weight[found.candidate.key] / total, max(group, weight[found.candidate.key]) / total


def _finding(
    scene: Scene,
    stage: Stage,
    found: Ranked,
    scan: Sequence[Ranked],
    c: Array,
    std: Array,
    ratio: Array,
    outcome: Outcome,
) -> Finding:
    candidate = found.candidate
    h, j = candidate.hypothesis, candidate.joint
    probability, group = probabilities(found, scan, outcome.null.named)
    where = candidate.joints or tuple(range(scene.joints))
    inflation = float(np.sqrt(max(1.0, np.nanmax([ratio[k] for k in where]))))
    parameters = _with_forms(scene, stage, found, h.parameters(scene, j, candidate.theta, c, std * inflation))
    rivals = [r for r in scan if r.candidate.key != candidate.key][:SHOWN]
    shown = [Rival(str(r.candidate.hypothesis.effect), _names(scene, r), float(r.gain)) for r in rivals if r.gain > 0]
    nearest = next((r for r in rivals if r.candidate.named), None)
    margin = (
        f"; {found.gain - max(nearest.gain, 0):.0f} nats ahead of {nearest.candidate.hypothesis.effect}"
        if nearest
        else ""
    )
    return Finding(
        effect=str(h.effect),
        group=h.group,
        joints=_names(scene, found),
        probability=probability,
        group_probability=group,
        parameters=parameters,
        gain_nats=float(found.gain),
        rivals=shown,
        because=h.because(scene, j, candidate.theta, c) + margin,
        cost_Nm=_cost(scene, found, c),
        curve=_curve(scene, found, c),
    )


def _rivals(one: Ranked, other: Ranked) -> bool:
    """They could explain the same excess: a joint in common, or one of them is the whole arm's."""
    a, b = set(one.candidate.joints), set(other.candidate.joints)
    return not a or not b or bool(a & b)


def _with_forms(scene: Scene, stage: Stage, found: Ranked, own: list[Parameter]) -> list[Parameter]:
    """Parameters with the spread over neighbouring forms that fit within `FORMS_NATS`."""
    candidate = found.candidate
    thetas = [
        t for step in (2.0, 1.0) for t in candidate.hypothesis.near(scene, candidate.joint, candidate.theta, step)
    ]
    b = candidates.batch(scene, candidate.hypothesis, candidate.joint, thetas)
    if b is None:
        return own
    gain, _, c, std = candidates.gains(scene, stage, b)
    near = [g for g in range(len(b.candidates)) if gain[g, 0] > found.gain - FORMS_NATS]
    values = {p.name: [p.value] for p in own}
    for g in near:
        other = b.candidates[g]
        for p in other.hypothesis.parameters(scene, other.joint, other.theta, c[g, :, 0], std[g]):
            values.setdefault(p.name, []).append(p.value)
    out = []
    for p in own:
        spread = max(abs(v - p.value) for v in values[p.name]) / np.sqrt(3)
        total = float(np.hypot(p.std, spread))
        out.append(Parameter(p.name, p.value, total, p.unit, p.value - 1.96 * total, p.value + 1.96 * total))
    return out


def _cost(scene: Scene, found: Ranked, c: Array) -> list[float]:
    where = found.candidate.joints or tuple(range(scene.joints))
    out = []
    for j in where:
        live = scene.weight[j] > 0
        if j not in found.columns or not live.any():
            out.append(0.0)
            continue
        torque = (found.columns[j] @ c)[live] / scene.weight[j][live]
        out.append(float(np.sqrt(np.mean(torque**2))))
    return out


def _curve(scene: Scene, found: Ranked, c: Array) -> Curve | None:
    """The effect's torque over its own variable."""
    h = found.candidate.hypothesis
    j = found.candidate.joint
    if not h.curve or j not in found.columns:
        return None
    live = scene.weight[j] > 0
    x = location.variables(scene, j)[CURVE_OF[h.curve]][live]
    torque = (found.columns[j] @ c)[live] / scene.weight[j][live]
    return location.curve(x, torque, f"{CURVE_OF[h.curve]} [{location.UNITS[CURVE_OF[h.curve]]}]", bins=40)


def of_event(scene: Scene, event: Event) -> Finding:
    """A contact."""
    joint = scene.model.robot.joint[event.joint].name
    duration = event.time_s[1] - event.time_s[0]
    unit = "N" if scene.model.geometry.prismatic[event.joint] else "N·m"
    noise = float(np.sqrt(scene.floor[event.joint]))
    return Finding(
        effect="contact",
        group="event",
        joints=[joint],
        probability=0.98,
        group_probability=0.99,
        parameters=[
            parameter(scene, event.joint, "contact", "start_s", event.time_s[0], 0.02),
            parameter(scene, event.joint, "contact", "duration_s", duration, 0.04),
            parameter(scene, event.joint, "contact", "limit_Nm", abs(event.torque_Nm), noise),
        ],
        gain_nats=float(event.z),
        rivals=[],
        because=(
            f"a torque of up to {abs(event.torque_Nm):.3g} {unit} from {event.time_s[0]:.2f} to {event.time_s[1]:.2f} s"
            " that the motion did not have at any other time"
        ),
        cost_Nm=[abs(event.torque_Nm)],
        time_s=event.time_s,
    )


def of_line(scene: Scene, line: Line) -> Finding:
    """A disturbance that keeps its own time."""
    joint = scene.model.robot.joint[line.joint].name
    return Finding(
        effect="disturbance.periodic",
        group="own time",
        joints=[joint],
        probability=0.98,
        group_probability=0.99,
        parameters=[
            parameter(scene, line.joint, "disturbance.periodic", "amplitude_Nm", line.amplitude_Nm, line.std_Nm),
            parameter(scene, line.joint, "disturbance.periodic", "frequency_Hz", line.frequency_Hz, 0.01),
            parameter(
                scene,
                line.joint,
                "disturbance.periodic",
                "phase_rad",
                line.phase_rad,
                line.std_Nm / max(line.amplitude_Nm, 1e-12),
            ),
        ],
        gain_nats=float(line.ratio),
        rivals=[],
        because=(
            f"a line at {line.frequency_Hz:.2f} Hz, {line.ratio:.0f} times the noise beside it, that differs from"
            " period to period of the motion"
        ),
        cost_Nm=[line.amplitude_Nm / np.sqrt(2)],
    )


def unexplained(competition: Competition, outcome: Outcome, least: float) -> list[Unexplained]:
    """What remains, per joint, largest first."""
    scene = competition.scene
    ratio = excess_ratio(scene, outcome.stage)
    out = []
    for j in range(scene.joints):
        mine = outcome.unlisted is not None and outcome.unlisted.candidate.joint == j
        if not mine and not ratio[j] > max(outcome.null.ratio[j], least):
            continue
        found = location.regimes(scene, outcome.stage, j)
        lead = found[0] if found and found[0].share > location.CLEAR else None
        organiser = lead.name + (" × direction" if lead.odd else "") if lead else "no static variable"
        form = f"ordered by {organiser}" if lead else "dynamic: no static variable orders it"
        drawn = lead.curve if lead else None
        if mine and outcome.unlisted is not None and isinstance(outcome.unlisted.candidate.hypothesis, AnyShape):
            shape = outcome.unlisted.candidate.hypothesis
            organiser, form = shape.organiser, _in_words(scene, outcome.unlisted, shape)
            drawn = _curve(scene, outcome.unlisted, outcome.unlisted.c) or drawn
        share = max(0.0, 100 * (1 - 1 / ratio[j])) if ratio[j] > 0 else 0.0
        name = scene.model.robot.joint[j].name
        out.append(Unexplained(joint=name, percent=share, organiser=organiser, form=form, curve=drawn))
    return sorted(out, key=lambda u: -u.percent)


def _in_words(scene: Scene, found: Ranked, shape: AnyShape) -> str:
    words = shape.form
    other = found.candidate.theta.get("other")
    if other is not None:
        words = words.replace("another joint", scene.model.robot.joint[int(other)].name)
    drawn = _curve(scene, found, found.c)
    if drawn is not None:
        peak = int(np.argmax(np.abs(drawn.y)))
        words += f", largest around {drawn.over.split(' ')[0]} {drawn.x[peak]:.3g}"
    return words + "; no effect of the list reproduces it"


def _names(scene: Scene, ranked: Ranked) -> list[str]:
    return [scene.model.robot.joint[j].name for j in ranked.candidate.joints]
