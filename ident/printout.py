"""An identification on a terminal."""

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from ident.contract import Fit, Result


def show(results: Sequence[Result], console: Console | None = None) -> None:
    """Print the essential parameters of every method side by side, then how well each fits.

    Args:
        results: Of the same recordings.
        console: Where to; stdout by default.
    """
    console = console or Console(highlight=False)
    first = results[0]
    known = any(p.truth is not None for p in first.parameters)
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("essential parameter")
    table.add_column("unit", style="dim")
    for result in results:
        table.add_column(result.method, justify="right")
        table.add_column("± std", justify="right", style="dim")
    if known:
        table.add_column("true", justify="right")
        table.add_column("(est - true) / std", justify="right")
    table.add_column("prior", justify="right", style="dim")
    by_name = [{p.name: p for p in r.parameters} for r in results]
    essential = [p for p in first.parameters if any(m[p.name].essential for m in by_name)]
    for parameter in essential:
        cells = [parameter.name, parameter.unit]
        for values in by_name:
            p = values[parameter.name]
            cells += [f"{p.value:.4f}", f"{p.std:.4f}"]
        if known and parameter.truth is not None:
            cells += [f"{parameter.truth:.4f}", f"{(parameter.value - parameter.truth) / parameter.std:+.1f}"]
        cells.append("" if parameter.prior is None else f"{parameter.prior:.4f}")
        table.add_row(*cells)
    console.print(table)
    console.print(f"{len(first.parameters) - len(essential)} more base parameters are too small to matter here.")
    for result in results:
        unseen = "" if result.validation is None else f", {_quality(result.validation)} on unseen motion"
        console.print(
            f"{result.method}: {_quality(result.fit)} on {result.fit.rows} rows{unseen};"
            f" condition number {result.condition_number:.0f}; {result.seconds:.1f} s"
        )


def _quality(fit: Fit) -> str:
    text = f"torque error {fit.relative_error_percent:.2f} %"
    if fit.noise_floor_percent is not None:
        text += f" (the true parameters leave {fit.noise_floor_percent:.2f} %)"
    return text
