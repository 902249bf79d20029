"""The report: one HTML file with everything inside, made from finished identifications."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from ident import contract, figures
from ident.identify import Identification
from ident.statistics import normalised_residuals

LAGS = 10
FAR = 3.0  # standard deviations from the truth beyond which a value is marked
Z_SCALE = 4.0  # standard deviations at the ends of the strip


@dataclass(frozen=True)
class Row:
    """One line of the parameter table, as text.

    Attributes:
        z: (identified - true) / standard deviation; None without truth.
        at: Place of z on the strip, 0 to 100.
    """

    parameter: contract.Parameter
    value: str
    std: str
    prior: str
    truth: str
    z: float | None
    at: float | None


def render(identifications: Sequence[Identification], title: str | None = None) -> str:
    """HTML of one recording set identified by one or several methods; the first is shown in full."""
    first = identifications[0]
    result = first.result
    shown = (first.unseen or first.seen)[0]
    joints = shown.joints
    residuals = normalised_residuals(first.estimate, first.seen)
    correlation = figures.autocorrelation(residuals, LAGS)
    rows = [_row(p) for p in result.parameters]
    known = [r for r in rows if r.z is not None]
    essential = [r for r in rows if r.parameter.essential]
    environment = Environment(
        loader=PackageLoader("ident"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("report.html.j2").render(
        title=title or f"Identification of {result.robot}",
        result=result,
        methods=[i.result for i in identifications],
        essential=essential,
        others=[r for r in rows if not r.parameter.essential],
        has_truth=bool(known),
        has_prior=any(p.prior for p in result.parameters),
        far=FAR,
        within=sum(abs(r.z or 0.0) <= FAR for r in essential if r.z is not None),
        compared=sum(r.z is not None for r in essential),
        floor_ratio=_floor_ratio(result.validation),
        verdict=_verdict(result.recordings),
        joints=_joints(first),
        torque_figure=figures.torques(shown, first.estimate.beta),
        torque_of=shown.source,
        torque_unseen=bool(first.unseen),
        residual_figure=figures.residuals(
            [run for joint in residuals for run in joint],
            correlation,
            joints,
            1.96 / np.sqrt(result.fit.rows / len(joints)),
        ),
    )


def _row(p: contract.Parameter) -> Row:
    digits = max(0, min(6, 1 - int(np.floor(np.log10(p.std))))) if p.std > 0 else 4
    z = None if p.truth is None or p.std <= 0 else (p.value - p.truth) / p.std
    return Row(
        parameter=p,
        value=f"{p.value:.{digits}f}",
        std=f"{p.std:.{digits}f}",
        prior="" if p.prior is None else f"{p.prior:.{digits}f}",
        truth="" if p.truth is None else f"{p.truth:.{digits}f}",
        z=z,
        at=None if z is None else 50 + 50 * float(np.clip(z / Z_SCALE, -1, 1)),
    )


def _floor_ratio(fit: contract.Fit | None) -> float | None:
    """Error on unseen motion over the error that the true parameters leave."""
    if fit is None or not fit.noise_floor_percent:
        return None
    return fit.relative_error_percent / fit.noise_floor_percent


def _verdict(recordings: Sequence[contract.Run]) -> str:
    """The worst of the recordings."""
    verdicts = [r.verdict for r in recordings]
    for word in ("GAPS", "UNVERIFIABLE"):
        for verdict in verdicts:
            if verdict.startswith(word):
                return verdict
    return "LOSSLESS"


def _joints(identification: Identification) -> list[Mapping[str, object]]:
    """Per joint: name, errors in percent, standard deviation of the error."""
    result = identification.result
    unseen = result.validation.per_joint_percent if result.validation else [None] * len(result.fit.per_joint_percent)
    return [
        {"name": name, "seen": seen, "unseen": other, "sigma": float(sigma), "lag1": float(lag1)}
        for name, seen, other, sigma, lag1 in zip(
            identification.seen[0].joints,
            result.fit.per_joint_percent,
            unseen,
            identification.estimate.sigma_Nm,
            identification.estimate.lag1,
            strict=True,
        )
    ]
