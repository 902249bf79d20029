"""An identification on a terminal."""

import math
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from ident.contract import Fit, Parameter, Result


def show(results: Sequence[Result], console: Console | None = None) -> None:
    """Print the essential parameters, several methods side by side, then how well each fits.

    Args:
        results: Of the same recordings.
        console: Where to; stdout by default.
    """
    console = console or Console(highlight=False, soft_wrap=True)
    by_name = [{p.name: p for p in r.parameters} for r in results]
    essential = [p for p in results[0].parameters if any(m[p.name].essential for m in by_name if p.name in m)]
    console.print(_one(results[0], essential) if len(results) == 1 else _side_by_side(results, essential))
    others = len(results[0].parameters) - len(essential)
    if others:
        console.print(f"{others} more base parameters are too small to matter here.")
    for result in results:
        console.print(f"{result.method}: {_quality(result.fit)} on {result.fit.rows} rows,")
        if result.validation is not None:
            console.print(f"  {_quality(result.validation)} on unseen motion,")
        console.print(f"  condition number {result.condition_number:.0f}, {result.seconds:.1f} s")


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for k, name in enumerate(columns):
        table.add_column(name, justify="left" if k == 0 else "right", no_wrap=True)
    return table


def _one(result: Result, essential: Sequence[Parameter]) -> Table:
    """Value, standard deviation, truth where known, prior."""
    known = any(p.truth is not None for p in result.parameters)
    table = _table("parameter", "unit", result.method, "± std", *(("true", "z") if known else ()), "prior")
    for p in essential:
        truth = [f"{p.truth:.4f}", f"{(p.value - p.truth) / p.std:+.1f}"] if p.truth is not None else []
        prior = "" if p.prior is None else f"{p.prior:.4f}"
        table.add_row(p.name, p.unit, f"{p.value:.4f}", f"{p.std:.4f}", *truth, prior)
    return table


def _side_by_side(results: Sequence[Result], essential: Sequence[Parameter]) -> Table:
    """Values of every method, the standard deviation of the last digits in parentheses."""
    known = any(p.truth is not None for p in essential)
    table = _table("parameter", *(r.method for r in results), *(("true",) if known else ()))
    for parameter in essential:
        cells = []
        for result in results:
            p = next((p for p in result.parameters if p.name == parameter.name), None)
            cells.append("" if p is None else _concise(p))
        truth = [f"{parameter.truth:.4f}"] if parameter.truth is not None else []
        table.add_row(parameter.name, *cells, *truth)
    return table


def _concise(p: Parameter) -> str:
    """1.2592(48) for 1.2592 ± 0.0048."""
    if not math.isfinite(p.std) or p.std <= 0:
        return f"{p.value:.4g}"
    digits = max(0, 1 - math.floor(math.log10(p.std)))
    return f"{p.value:.{digits}f}({p.std * 10**digits:.0f})"


def _quality(fit: Fit) -> str:
    text = f"torque error {fit.relative_error_percent:.2f} %"
    if fit.noise_floor_percent is not None:
        text += f" (the true parameters leave {fit.noise_floor_percent:.2f} %)"
    return text
