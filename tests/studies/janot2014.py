"""The tables of Janot, Vandanjon & Gautier 2014 on the emulated TX40, beside the paper's: `make janot`.

The machine has the parameters of Table 3. It is driven along fifth-order polynomials, recorded through every CAN frame,
and identified from the recording. Torque noise is set so that least squares leaves the paper's 5 to 6 %, encoder noise
so that differentiating positions twice without a filter is as hopeless as in V.C (the paper samples at 5 kHz, this rig
at 1 kHz, so it takes 1e-3 degree). Filters as in V.B: 50 Hz Butterworth, decimation to 50 Hz rows.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from rich.console import Console
from rich.table import Table

from daq.recorder import Recorder
from emulator.host import Host
from emulator.lockstep import lockstep
from emulator.machine import load_machine
from emulator.rig import EmulatedRig
from ident.base import base_parameters
from ident.cloe import Cloe
from ident.dataset import Signals, prepare
from ident.didim import Didim
from ident.estimate import Estimate, LeastSquares
from ident.identify import truth_values
from ident.iv import IdimIv
from ident.model import Model
from ident.observation import observe
from ident.problem import Estimator, Problem
from ident.recorded import signals
from ident.reduction import reduce
from ident.tls import TotalLeastSquares
from protocols import config
from protocols.errors import IdentificationError
from protocols.motion import Motion
from protocols.recording import read_recording
from protocols.rig import load_rig

MOTION = "tx40-test"
CURRENT, ENCODER = 1.9, 10.0  # noise, in units of the shipped rig's
QUIET = 0.2  # torque noise of the second recording, for output error

# Name: Table 2 (LS, filtered), Table 3 (IV, filtered), 6 (LS, raw), 7 (IV, raw), 8 (TLS, raw)
PAPER = {
    "ZZ1R": (1.25, 1.25, 0.06, 1.25, 0.11), "Fv1": (8.18, 8.20, 8.10, 8.25, 8.05),
    "Fc1": (6.57, 6.55, 6.06, 6.50, 6.00), "XX2R": (-0.48, -0.48, -0.08, -0.48, -0.12),
    "XZ2R": (-0.16, -0.16, -0.02, -0.16, -0.08), "ZZ2R": (1.08, 1.09, 0.05, 1.08, 0.43),
    "MX2R": (2.20, 2.21, 4.20, 2.20, 3.21), "Fv2": (5.67, 5.68, 5.15, 5.68, 5.22),
    "Fc2": (7.76, 7.77, 8.26, 7.73, 8.20), "XX3R": (0.13, 0.13, -0.01, 0.13, -0.01),
    "ZZ3R": (0.12, 0.12, -0.05, 0.11, 0.05), "MY3R": (-0.60, -0.60, -0.30, -0.60, -0.40),
    "Ia3": (0.09, 0.10, 0.05, 0.10, 0.07), "Fv3": (2.02, 2.03, 2.21, 2.06, 2.10),
    "Fc3": (6.10, 6.00, 5.56, 5.90, 5.60), "MX4": (-0.02, -0.02, 0.06, -0.02, 0.01),
    "Ia4": (0.03, 0.03, 0.01, 0.03, 0.01), "Fv4": (1.14, 1.15, 1.20, 1.16, 1.18),
    "Fc4": (2.30, 2.27, 2.30, 2.20, 2.30), "MY5R": (-0.03, -0.03, -0.02, -0.03, -0.03),
    "Ia5": (0.04, 0.04, 0.01, 0.04, 0.02), "Fv5": (1.88, 1.90, 1.84, 1.95, 1.91),
    "Fc5": (2.90, 2.80, 2.85, 2.80, 2.80), "Ia6": (0.01, 0.01, 0.001, 0.01, 0.005),
    "Fv6": (0.68, 0.69, 0.68, 0.69, 0.68), "Fc6": (2.10, 2.00, 2.00, 2.00, 2.00),
    "fv_m6": (0.63, 0.63, 0.64, 0.64, 0.65), "fc_m6": (1.80, 1.81, 1.74, 1.79, 1.75),
}  # fmt: skip
TABLE_5 = ((0.080, 0.050, 0.050, 0.051, 0.100, 0.120), (0.078, 0.045, 0.048, 0.050, 0.097, 0.119))  # k = 0, k = 3


@dataclass(frozen=True)
class Study:
    """A recording identified in several ways.

    Attributes:
        found: By name of method and `filtered` or `raw`; the message where a method refused.
        truth: Base parameters of the machine.
    """

    names: list[str]
    truth: np.ndarray
    found: dict[tuple[str, str], Estimate | str]


def record(path: Path, seed: int, current: float, encoder: float) -> Signals:
    """The motion through the whole chain, noise in units of the shipped rig's."""
    rig, robot = load_rig("tx40-rig")
    emulated = msgspec.structs.replace(
        rig.emulated,
        seed=seed,
        current_noise_A=tuple(current * x for x in rig.emulated.current_noise_A),
        encoder_noise_rad=tuple(encoder * x for x in rig.emulated.encoder_noise_rad),
    )
    rig = msgspec.structs.replace(rig, emulated=emulated)
    buses = [b.name for b in rig.bus]
    recorder = Recorder(path, rig, robot, seed=seed)
    lockstep(
        EmulatedRig(rig, load_machine(rig, robot)),
        Host(rig, robot, config.read(config.locate(MOTION), Motion)),
        rig.sync_period_us * 1000,
        lambda t_ns, bus, frames: recorder.frames(buses[bus], [(t_ns, f) for f in frames]),
    )
    recorder.close()
    return signals(read_recording(path))


def study(run: Signals, methods: Sequence[tuple[str, Estimator]]) -> Study:
    """All estimates of a recording.

    Args:
        methods: Pairs of `filtered` or `raw` and a method.
    """
    rig, robot = load_rig("tx40-rig")
    model = Model.of(robot)
    base = base_parameters(model)
    truth = np.array(list(truth_values(robot, load_machine(rig, robot)).values()))
    problems = {}
    for name, filter_Hz, rate_Hz in (("filtered", 50.0, 50.0), ("raw", np.inf, np.inf)):
        dataset = prepare(run, filter_Hz)
        rows = [observe(dataset, model, base, rate_Hz)]
        problems[name] = Problem(model, base, [run], [dataset], rows, rate_Hz, None)
    found: dict[tuple[str, str], Estimate | str] = {}
    for kind, method in methods:
        try:
            found[method.name, kind] = method.fit(problems[kind])
        except IdentificationError as error:
            found[method.name, kind] = str(error)
    return Study(base.names, truth, found)


def main() -> None:
    console = Console(highlight=False, width=150)
    with tempfile.TemporaryDirectory() as folder:
        run = record(Path(folder) / "noisy.mcap", 301, CURRENT, ENCODER)
        quiet = record(Path(folder) / "quiet.mcap", 302, QUIET, 1.0)
    least_squares, iv, tls = LeastSquares(weighted=True), IdimIv(), TotalLeastSquares()
    methods: list[tuple[str, Estimator]] = [(kind, m) for m in (least_squares, iv, tls) for kind in ("filtered", "raw")]
    ours = study(run, [*methods, ("filtered", Didim()), ("filtered", Cloe())])
    values(console, ours)
    convergence(console, ours)
    agreement(console, ours)
    reduction(console, ours)
    output_error(console, ours, quiet)


def values(console: Console, ours: Study) -> None:
    """Tables 2, 3, 6, 7 and 8."""
    columns = [
        ("IDIM-WLS", "filtered", 0, "2 LS"),
        ("IDIM-IV", "filtered", 1, "3 IV"),
        ("IDIM-WLS", "raw", 2, "6 LS raw"),
        ("IDIM-IV", "raw", 3, "7 IV raw"),
        ("IDIM-TLS", "raw", 4, "8 TLS raw"),
    ]
    table = Table("", title="Tables 2, 3, 6, 7, 8: the paper's value, then ours ± standard deviation", box=None)
    table.add_column("true")
    for *_, title in columns:
        table.add_column(title, justify="right")
        table.add_column("ours", justify="left")
    for name, paper in PAPER.items():
        i = ours.names.index(name)
        cells = [name, f"{ours.truth[i]:.3f}"]
        for method, kind, column, _ in columns:
            e = ours.found[method, kind]
            cells += [f"{paper[column]:g}", "refused" if isinstance(e, str) else f"{e.beta[i]:.3f} ± {e.std[i]:.3f}"]
        table.add_row(*cells)
    console.print(table)
    for (method, kind), e in ours.found.items():
        if isinstance(e, str):
            console.print(f"{method}, {kind}: {e}")
        else:
            away = np.sqrt(np.mean(((e.beta - ours.truth) / e.std) ** 2))
            console.print(
                f"{method}, {kind}: torque error {e.relative_error_percent:.2f} %, {e.iterations} iterations,"
                f" all 60 parameters off by {away:.2f} standard deviations (rms)"
            )


def convergence(console: Console, ours: Study) -> None:
    """Tables 4 and 5."""
    for kind in ("filtered", "raw"):
        e = ours.found["IDIM-IV", kind]
        if isinstance(e, str):
            continue
        history = e.history
        table = Table("", title=f"Table 4, {kind}: IDIM-IV from the regular initialisation (paper: 3 steps)", box=None)
        for k in range(len(history)):
            table.add_column(f"k = {k}", justify="right")
        for name in ("ZZ1R", "Fv1", "Fc1", "ZZ2R", "MX2R", "Ia3", "Ia5", "fc_m6"):
            i = ours.names.index(name)
            table.add_row(name, *(f"{h.beta[i]:.3f}" for h in history))
        console.print(table)
        table = Table("", title="Table 5: norm of the position error, %", box=None)
        for title in ("paper k = 0", "paper k = 3", *(f"k = {k}" for k in range(len(history)))):
            table.add_column(title, justify="right")
        for j in range(6):
            paper = [f"{column[j]:.3f}" for column in TABLE_5]
            table.add_row(f"joint {j + 1}", *paper, *(f"{h.position_error_percent[j]:.3f}" for h in history))
        console.print(table)


def agreement(console: Console, ours: Study) -> None:
    """Do least squares and instrumental variables agree?"""
    for kind in ("filtered", "raw"):
        e = ours.found["IDIM-IV", kind]
        if isinstance(e, str):
            continue
        (test,) = e.tests
        console.print(f"{kind}: {test.name} F = {test.statistic:.1f}, p = {test.p_value:.2g}, {test.verdict}.")
        console.print("  " + next(note for note in e.notes if note.startswith("Weighted least squares")))


def reduction(console: Console, ours: Study) -> None:
    """60 to 28 parameters (V.B)."""
    for kind in ("filtered", "raw"):
        e = ours.found["IDIM-IV", kind]
        if isinstance(e, str):
            continue
        r = reduce(e)
        essential = [name for name, keep in zip(ours.names, r.essential, strict=True) if keep]
        console.print(
            f"{kind}: F accepts {len(ours.names)} -> {len(essential)} parameters (paper 60 -> 28), F = {r.F:.2f} (limit"
            f" {r.F_limit:.2f}); not in the paper's 28: {', '.join(set(essential) - set(PAPER)) or 'none'}; missing:"
            f" {', '.join(set(PAPER) - set(essential)) or 'none'}"
        )


def output_error(console: Console, ours: Study, quiet: Signals) -> None:
    """CLOE against IDIM-IV, from acceptable values and from the regular initialisation (V.E)."""
    settings = (
        ("robot file", Cloe()),
        ("regular, plain", Cloe(start="regular", halvings=0)),
        ("regular, halved", Cloe(start="regular")),
    )
    iv = study(quiet, [("filtered", IdimIv())]).found["IDIM-IV", "filtered"]
    for start, method in settings:
        e = study(quiet, [("filtered", method)]).found["CLOE", "filtered"]
        if isinstance(e, str) or isinstance(iv, str):
            console.print(f"CLOE, start {start}: {e}")
            continue
        heavy = [ours.names.index(name) for name in PAPER]
        away = np.abs(e.beta - iv.beta)[heavy] / np.maximum(np.abs(iv.beta[heavy]), 1e-9)
        worst = list(PAPER)[int(away.argmax())]
        console.print(
            f"CLOE, start {start}, torque noise a tenth: {e.iterations} iterations; the paper's 28 parameters differ"
            f" from IDIM-IV by {100 * np.median(away):.1f} % (median), {100 * away.max():.1f} % at most ({worst})"
        )


if __name__ == "__main__":
    main()
