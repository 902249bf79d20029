"""The `armrig` command: the one place that knows all four parts.

Every command imports what it needs when it runs, so that `armrig --help` stays instant. Results go to stdout, the
log to stderr; an error is one sentence and an exit code (0 done, 1 bug, 2 usage or configuration, 3 data unusable,
4 not identifiable or not converged, 5 peer, bus or service unreachable).
"""

import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer

from protocols.errors import ArmrigError, ConfigError

if TYPE_CHECKING:
    from emulator.rig import EmulatedRig
    from protocols.motion import Motion
    from protocols.rig import Rig
    from protocols.robot import Robot

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Hardware-in-the-loop test rig, acquisition and identification for robot arms.",
)

RigFile = Annotated[str, typer.Argument(metavar="RIG", help="Rig file, or a shipped rig such as tx40-rig.")]
BusOption = Annotated[
    list[str] | None,
    typer.Option(
        "--bus",
        metavar="BUS",
        help="NAME=INTERFACE:CHANNEL moves a bus, such as can0=socketcan:vcan0. A single - is a pipe of candump text.",
    ),
]
DurationOption = Annotated[float | None, typer.Option("--duration", metavar="S", min=0.0, help="Stop after so long.")]
JsonOption = Annotated[
    str | None,
    typer.Option("--json", metavar="FILE", help="Machine-readable result; - for stdout, with nothing else there."),
]
Recordings = Annotated[list[str], typer.Argument(metavar="RUN.mcap...", help="Recordings.")]

PIPE = ["-"]


def main() -> None:
    """Run the command line; every error of the user, the data or a peer ends here as one sentence."""
    try:
        app()
    except ArmrigError as error:
        print(f"armrig: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from None
    except BrokenPipeError:  # whoever read our output has gone: nothing left to say
        raise SystemExit(0) from None


# --- what commands share ---


def log(text: str) -> None:
    """A line for people, on stderr."""
    print(text, file=sys.stderr, flush=True)


@contextmanager
def stopping() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set, so that every loop ends at a safe point."""
    stop = threading.Event()
    before = {n: signal.signal(n, lambda *_: stop.set()) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def load(name: str, moved: Sequence[str] | None = None) -> "tuple[Rig, Robot]":
    """Rig and nominal robot, with `--bus` applied.

    Raises:
        ConfigError: As `load_rig`; a `--bus` that names no bus of the rig or has another form.
    """
    from protocols.rig import load_rig

    rig, robot = load_rig(name)
    buses = {b.name: b for b in rig.bus}
    for text in moved or []:
        bus, _, place = text.partition("=")
        interface, _, channel = place.partition(":")
        if bus not in buses or not channel:
            raise ConfigError(
                f"--bus {text}: write NAME=INTERFACE:CHANNEL with a bus of {rig.name} ({', '.join(buses)}),"
                " such as can0=socketcan:vcan0."
            )
        buses[bus] = msgspec.structs.replace(buses[bus], interface=interface, channel=channel)
    return msgspec.structs.replace(rig, bus=list(buses.values())), robot


def report_loads(rig: "Rig") -> None:
    """What the cyclic traffic does to each bus."""
    from protocols.rig import BUSY_BUS

    for bus, share in rig.loads().items():
        advice = "; vendors advise at most 80 %" if share > BUSY_BUS else ""
        log(f"{bus}: worst-case load {100 * share:.0f} %{advice}")


def write_json(value: Any, destination: str | None) -> None:
    """Result of a command for `--json`."""
    if destination is None:
        return
    text = msgspec.json.format(msgspec.json.encode(value), indent=2)
    if destination == "-":
        sys.stdout.write(text.decode() + "\n")
    else:
        Path(destination).write_bytes(text + b"\n")


def emulated(rig: "Rig", robot: "Robot", rig_name: str, seed: int | None) -> "EmulatedRig":
    """The rig with its machine."""
    from emulator.machine import load_machine
    from emulator.rig import EmulatedRig
    from protocols.config import locate

    if seed is not None:
        rig = msgspec.structs.replace(rig, emulated=msgspec.structs.replace(rig.emulated, seed=seed))
    return EmulatedRig(rig, load_machine(rig, robot, locate(rig_name).parent))


def load_motion(name: str) -> "Motion":
    from protocols import config
    from protocols.motion import Motion

    return config.read(config.locate(name), Motion)


# --- the rig ---


@app.command()
def emulate(
    rig: RigFile,
    bus: BusOption = None,
    clock: Annotated[str, typer.Option(help="real, or sim: as fast as the CPU allows; needs --motion.")] = "real",
    motion: Annotated[str | None, typer.Option(metavar="MOTION", help="With --clock sim: what the host does.")] = None,
    duration: DurationOption = None,
    seed: Annotated[int | None, typer.Option(help="Of everything random; the rig file's otherwise.")] = None,
) -> None:
    """Emulate a rig: its drives on CAN, the arm behind them, the cell on Modbus/TCP.

    In real time it serves the virtualcan buses of the rig file and runs until Ctrl-C. In simulated time host and rig
    run in lock-step and the buses are written to stdout as candump text, for `armrig record RIG --bus -`.
    """
    if clock == "sim":
        simulate(rig, motion, seed)
    elif clock == "real":
        emulate_on_buses(rig, [] if bus is None else bus, duration, seed)
    else:
        raise ConfigError(f"--clock {clock}: choose real or sim.")


def simulate(rig_name: str, motion: str | None, seed: int | None) -> None:
    from emulator.host import Host
    from emulator.lockstep import lockstep
    from protocols.candump import format_frame

    if motion is None:
        raise ConfigError("--clock sim needs --motion: without a real clock, host and rig run in one process.")
    rig, robot = load(rig_name)
    report_loads(rig)
    host = Host(rig, robot, load_motion(motion))
    cell = emulated(rig, robot, rig_name, seed)
    names = [b.name for b in rig.bus]
    write = sys.stdout.write

    def tap(t_ns: int, bus: int, frames: Sequence[Any]) -> None:
        if frames:
            write("".join([format_frame(t_ns, names[bus], f) + "\n" for f in frames]))

    begin = RealTime()
    with stopping() as stop:
        simulated_ns = lockstep(cell, host, rig.sync_period_us * 1000, tap, stop.is_set)
    sys.stdout.flush()
    log(f"{simulated_ns * 1e-9:.1f} s simulated in {begin.seconds:.1f} s: {simulated_ns * 1e-9 / begin.seconds:.1f}x")


class RealTime:
    """How long something takes."""

    def __init__(self) -> None:
        from protocols.clock import RealClock

        self._clock = RealClock()

    @property
    def seconds(self) -> float:
        return self._clock.now_ns() * 1e-9


def emulate_on_buses(rig_name: str, moved: Sequence[str], duration: float | None, seed: int | None) -> None:
    from emulator.bus import open_bus
    from emulator.cell import CellServer
    from emulator.hubprocess import HubProcess
    from emulator.shell import emulate as run
    from protocols.clock import RealClock

    rig, robot = load(rig_name, moved)
    report_loads(rig)
    arm = emulated(rig, robot, rig_name, seed)
    with ExitStack() as stack:
        served = [(b.name, b.channel) for b in rig.bus if b.interface == "virtualcan"]
        channels = stack.enter_context(HubProcess(served)).channels if served else {}
        opened = [msgspec.structs.replace(b, channel=channels.get(b.name, b.channel)) for b in rig.bus]
        buses = [stack.enter_context(open_bus(b)) for b in opened]
        stop = stack.enter_context(stopping())
        cell = None if rig.cell is None else CellServer(rig.cell)
        if cell is not None:
            cell.start()
            stack.callback(cell.stop)
        places = ", ".join(f"{b.name} {b.interface}:{b.channel}" for b in opened)
        log(f"{rig.name} is running on {places}" + (f", cell on {rig.cell.host}:{rig.cell.port}" if rig.cell else ""))
        run(arm, buses, RealClock(), stop, duration, None if cell is None else lambda t_ns: cell.update(arm.cell(t_ns)))
    log(f"{arm.cycles} cycles; {arm.skewed} at which a bus had no SYNC")


@app.command()
def move(
    rig: RigFile,
    motion: Annotated[str, typer.Option(metavar="MOTION", help="Motion file, or a shipped one such as tx40-train.")],
    bus: BusOption = None,
    mode: Annotated[str, typer.Option(help="cst: the PD law runs in the host; csp: in the drives.")] = "cst",
) -> None:
    """Drive the arm: NMT start, enable, stream references at the SYNC rate, stop safely. Ctrl-C brakes and disables."""
    from emulator.bus import open_bus
    from emulator.host import Host
    from emulator.shell import move as run
    from protocols.cia402 import Mode
    from protocols.clock import RealClock

    if mode not in {"cst", "csp"}:
        raise ConfigError(f"--mode {mode}: choose cst or csp.")
    cell, robot = load(rig, bus)
    host = Host(cell, robot, load_motion(motion), Mode[mode.upper()])
    with ExitStack() as stack:
        buses = [stack.enter_context(open_bus(b)) for b in cell.bus]
        stop = stack.enter_context(stopping())
        print(run(host, buses, RealClock(), stop, cell.sync_period_us * 1000))
