"""An explanation as text for a terminal."""

from collections.abc import Iterator

from ident.explain.contract import Explanation, Finding, Pair

SHOWN = 6  # lines of a list that a person reads


def render(explanation: Explanation) -> str:
    """The answer in a page: what is missing, where, how sure, what it costs, what to do next."""
    return "\n".join(_lines(explanation)) + "\n"


def _lines(e: Explanation) -> Iterator[str]:
    yield f"{e.robot}: {e.verdict}. {e.summary}"
    if e.located:
        yield ""
        yield "Where the refitted model fails"
        yield from (f"  {place.sentence}" for place in e.located[:SHOWN])
    if e.findings:
        yield ""
        yield "What was left out"
        for finding in e.findings:
            yield from _finding(finding)
    if e.unexplained:
        yield ""
        yield "What remains"
        yield from (f"  {u.joint}: {u.percent:.0f} % of the residual; {u.form}" for u in e.unexplained[:SHOWN])
    yield ""
    yield from _improvement(e)
    if e.next_experiments:
        yield ""
        yield "Record next"
        for experiment in e.next_experiments[:SHOWN]:
            yield f"  {experiment.motion} ({experiment.resolves}; about {experiment.expected_nats:.0f} nats)"
    seen = [p for p in e.power if p.smallest is not None]
    if seen:
        yield ""
        yield "Smallest effects that these recordings would have shown"
        for joint in e.joints:
            row = ", ".join(f"{p.effect} {p.smallest:.3g} {p.parameter}" for p in seen if p.joint == joint)
            if row:
                yield f"  {joint}: {row}"
    if e.notes:
        yield ""
        yield "Notes"
        yield from (f"  {note}" for note in e.notes)


def _finding(f: Finding) -> Iterator[str]:
    where = ", ".join(f.joints) or "whole arm"
    yield (
        f"  {f.effect} on {where}: probability {100 * f.probability:.0f} % (group {f.group}"
        f" {100 * f.group_probability:.0f} %), {f.gain_nats:.0f} nats"
    )
    for p in f.parameters:
        yield f"    {p.name} = {p.value:.4g} ± {p.std:.2g} {p.unit}"
    yield f"    because {f.because}"
    if f.rivals:
        yield "    rivals: " + ", ".join(f"{r.effect} {r.gain_nats:.0f}" for r in f.rivals[:3])


def _improvement(e: Explanation) -> Iterator[str]:
    levels = e.before_after.levels
    yield (
        f"Torque error on {'unseen motion' if e.before_after.torque_error_percent.unseen else 'the recordings'}:"
        f" robot file {_percent(levels.prior)}, refitted {_percent(levels.refitted)}, explained"
        f" {_percent(levels.explained)}"
    )
    if e.before_after.excess_ratio.unseen:
        yield f"Residual over noise power, unseen: {_arrow(e.before_after.excess_ratio.unseen, '')}"
    if e.before_after.position_error.unseen:
        yield f"Closed-loop position mismatch, unseen: {_arrow(e.before_after.position_error.unseen, ' rad or m')}"


def _percent(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2f} %"


def _arrow(pair: Pair, unit: str) -> str:
    return " -> ".join("unknown" if v is None else f"{v:.3g}" for v in pair) + unit
