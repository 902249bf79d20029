"""Figures of the report as inline SVG: they stay sharp, and the file needs nothing from outside."""

import io
import re
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ident.observation import Observation

Array = NDArray[np.float64]

MEASURED, PREDICTED, RESIDUAL = "#94a3b8", "#0f766e", "#c2410c"
UNUSED, GRID = "#cbd5e1", "#e2e8f0"
SHOWN_S = 12.0  # of the motion: more is unreadable on paper
STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 8.5,
    "svg.fonttype": "none",  # text stays text: searchable, small
    "svg.hashsalt": "armrig",  # same input, same file
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#94a3b8",
    "axes.grid": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "xtick.color": "#475569",
    "ytick.color": "#475569",
    "axes.labelcolor": "#334155",
    "legend.frameon": False,
    "path.simplify_threshold": 0.3,
}


def torques(observation: Observation, beta: Array) -> str:
    """Measured and predicted torque with the residual below, per joint; rows not used are shaded."""
    J = len(observation.joints)
    columns = min(2, J)
    rows = -(-J // columns)
    shown = _shown(observation)
    t = observation.t_s[shown]
    predicted = observation.predict(beta)[:, shown]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10.4, 2.55 * rows + 0.4), layout="constrained")
        grids = figure.add_gridspec(rows, columns)
        for j, name in enumerate(observation.joints):
            pair = grids[j % rows, j // rows].subgridspec(2, 1, height_ratios=[3, 1.1], hspace=0.06)
            axis = figure.add_subplot(pair[0])
            measured = observation.y[j, shown]
            axis.plot(t, _broken(observation, shown, measured), color=MEASURED, lw=2.4, label="measured")
            axis.plot(t, _broken(observation, shown, predicted[j]), color=PREDICTED, lw=0.9, label="predicted")
            axis.set_title(name, loc="left", fontsize=9.5, fontweight="bold", color="#0f172a")
            axis.set_ylabel("torque [N·m]")
            axis.tick_params(labelbottom=False)
            below = figure.add_subplot(pair[1], sharex=axis)
            residual = _broken(observation, shown, measured - predicted[j])
            used = observation.used[j, shown]
            below.plot(t, np.where(used, residual, np.nan), color=RESIDUAL, lw=0.8, label="residual")
            below.plot(t, np.where(used, np.nan, residual), color=UNUSED, lw=0.7)
            below.set_ylabel("residual")
            below.margins(x=0)
            for ax in (axis, below):
                _shade(ax, t, ~used)
            if j % rows == rows - 1 or j == J - 1:
                below.set_xlabel("time [s]")
            else:
                below.tick_params(labelbottom=False)
            if j == 0:
                handles = [*axis.get_lines(), below.get_lines()[0]]
                figure.legend(handles=handles, loc="outside upper right", ncols=3, fontsize=9)
        return _svg(figure, "Measured and predicted torque per joint")


def residuals(normalised: Sequence[Array], correlation: Array, joints: Sequence[str], limit: float) -> str:
    """Histogram of normalised residuals against N(0, 1), and their autocorrelation.

    Args:
        correlation: shape (J, lags), from lag 1.
        limit: 95 % band of uncorrelated residuals.
    """
    values = np.concatenate(list(normalised)) if normalised else np.zeros(1)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(10.4, 2.9), layout="constrained")
        left, right = figure.subplots(1, 2)
        edges = np.linspace(-4.5, 4.5, 46)
        left.hist(np.clip(values, -4.5, 4.5), bins=list(edges), density=True, color="#99c9c4", ec="white", lw=0.4)
        x = np.linspace(-4.5, 4.5, 181)
        left.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color=RESIDUAL, lw=1.3, label="N(0, 1)")
        left.set_xlabel("residual / standard deviation of its joint")
        left.set_ylabel("density")
        left.legend()
        lags = np.arange(1, correlation.shape[1] + 1)
        shades = matplotlib.colormaps["viridis"](np.linspace(0.05, 0.85, len(joints)))
        for name, row, colour in zip(joints, correlation, shades, strict=True):
            right.plot(lags, row, "o-", ms=3, lw=1, label=name, color=colour)
        right.axhspan(-limit, limit, color="#f1f5f9", zorder=0)
        right.axhline(0, color="#94a3b8", lw=0.8)
        right.set_xticks(lags)
        right.set_xlabel("lag [rows]")
        right.set_ylabel("autocorrelation")
        right.set_ylim(min(-0.35, float(np.nanmin(correlation)) - 0.05), max(0.5, float(np.nanmax(correlation)) + 0.1))
        right.legend(ncols=3, fontsize=7.5)
        return _svg(figure, "Residual histogram and autocorrelation")


def autocorrelation(normalised: Sequence[Sequence[Array]], lags: int) -> Array:
    """Of each joint's unbroken runs, shape (J, lags).

    Args:
        normalised: Runs per joint.
    """
    out = np.full((len(normalised), lags), np.nan)
    for j, runs in enumerate(normalised):
        square, n = sum(float(r @ r) for r in runs), sum(r.size for r in runs)
        for lag in range(1, lags + 1):
            pairs = sum(max(0, r.size - lag) for r in runs)
            if square > 0 and pairs > 0:
                out[j, lag - 1] = sum(float(r[lag:] @ r[:-lag]) for r in runs if r.size > lag) / pairs / (square / n)
    return out


def _shown(observation: Observation) -> slice:
    count = round(SHOWN_S * observation.rate_Hz)
    start = max(0, (observation.t_s.size - count) // 2)
    return slice(start, min(observation.t_s.size, start + count))


def _broken(observation: Observation, shown: slice, values: Array) -> Array:
    """Lines are not drawn over gaps."""
    return np.where(observation.first[shown], np.nan, values)


def _shade(axis: Axes, t: Array, flags: NDArray[np.bool_]) -> None:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    for start, end in edges.reshape(-1, 2):
        axis.axvspan(t[start], t[end - 1], color="#f1f5f9", lw=0, zorder=0)


def _svg(figure: Figure, title: str) -> str:
    out = io.StringIO()
    figure.savefig(out, format="svg", metadata={"Date": None, "Title": title})
    text = out.getvalue()
    svg = text[text.index("<svg") :]
    svg = re.sub(r'width="[\d.]+pt" height="[\d.]+pt" ', f'role="img" aria-label="{title}" ', svg, count=1)
    return svg
