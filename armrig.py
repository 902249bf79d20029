"""The `armrig` command: the one place that knows all four parts.

Every command imports what it needs when it runs, so that `armrig --help` stays instant. Results go to stdout, the
log to stderr; an error is one sentence and an exit code (0 done, 1 bug, 2 usage or configuration, 3 data unusable,
4 not identifiable or not converged, 5 peer, bus or service unreachable).
"""

import math
import os
import signal
import sys
import threading
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer

from protocols.errors import ArmrigError, ConfigError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from emulator.rig import EmulatedRig
    from protocols.messages import Attached, Logged, Method
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
EffectOption = Annotated[
    list[str] | None,
    typer.Option(
        "--effect", metavar="KEY@JOINT:name=value", help="Physics beyond the machine file, such as spring@joint3."
    ),
]
FaultOption = Annotated[
    list[str] | None,
    typer.Option("--fault", metavar="KIND@PLACE:t=S", help="What goes wrong, such as heartbeat-loss@joint3:t=5."),
]
TimingOption = Annotated[
    str, typer.Option("--bus-timing", help="ideal: frames take no time; true: lengths, arbitration and load of CAN.")
]
DurationOption = Annotated[float | None, typer.Option("--duration", metavar="S", min=0.0, help="Stop after so long.")]
JsonOption = Annotated[
    str | None,
    typer.Option("--json", metavar="FILE", help="Machine-readable result; - for stdout, with nothing else there."),
]
Recordings = Annotated[list[str], typer.Argument(metavar="RUN.mcap...", help="Recordings.")]

PIPE = ["-"]
INTERRUPTED = 130  # what shells report of a process that Ctrl-C ended


def main() -> None:
    """Run the command line; every error of the user, the data or a peer ends here as one sentence."""
    # Our matrices are small and many: a second BLAS thread made the same fit 70 times slower (measured).
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        app()
    except ArmrigError as error:
        print(f"armrig: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from None
    except KeyboardInterrupt:  # before a command had set up its own safe end
        raise SystemExit(INTERRUPTED) from None
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


def emulated(rig: "Rig", robot: "Robot", rig_name: str, seed: int | None, effects: Sequence[str]) -> "EmulatedRig":
    """The rig with its machine and what `--effect` adds to it."""
    from emulator.machine import load_machine
    from emulator.rig import EmulatedRig
    from protocols.config import locate
    from protocols.effectentries import parse_effect

    added = [*rig.emulated.effect, *(parse_effect(text) for text in effects)]
    seed = rig.emulated.seed if seed is None else seed
    rig = msgspec.structs.replace(rig, emulated=msgspec.structs.replace(rig.emulated, seed=seed, effect=added))
    return EmulatedRig(rig, load_machine(rig, robot, locate(rig_name).parent))


def schedule(rig: "EmulatedRig", faults: Sequence[str]) -> None:
    """Faults of drives; those of buses belong to the wires."""
    from emulator.disturbance import is_disturbance
    from emulator.faults import parse_fault

    for text in faults:
        if not is_disturbance(text):
            rig.schedule(parse_fault(text))


def idle(joints: int) -> "tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]":
    """What a plant is told of drives that are off."""
    import numpy as np

    return np.zeros(joints, dtype=np.int64), np.zeros(joints), np.zeros(joints)


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
    effect: EffectOption = None,
    fault: FaultOption = None,
    bus_timing: TimingOption = "ideal",
) -> None:
    """Emulate a rig: its drives on CAN, the arm behind them, the cell on Modbus/TCP.

    In real time it serves the virtualcan buses of the rig file and runs until Ctrl-C. In simulated time host and rig
    run in lock-step and the buses are written to stdout as candump text, for `armrig record RIG --bus -`.
    """
    if clock == "sim":
        simulate(rig, motion, seed, effect or [], fault or [], bus_timing)
    elif clock == "real":
        emulate_on_buses(rig, bus or [], duration, seed, effect or [], fault or [], bus_timing)
    else:
        raise ConfigError(f"--clock {clock}: choose real or sim.")


def simulate(
    rig_name: str, motion: str | None, seed: int | None, effects: Sequence[str], faults: Sequence[str], timing: str
) -> None:
    from emulator.bustiming import wires
    from emulator.host import Host
    from emulator.lockstep import lockstep
    from protocols.candump import format_frame

    if motion is None:
        raise ConfigError("--clock sim needs --motion: without a real clock, host and rig run in one process.")
    rig, robot = load(rig_name)
    report_loads(rig)
    host = Host(rig, robot, load_motion(motion))
    wire = wires(rig, timing, faults)
    cell = emulated(rig, robot, rig_name, seed, effects)
    schedule(cell, faults)
    names = [b.name for b in rig.bus]
    write = sys.stdout.write

    def tap(t_ns: int, bus: int, frames: Sequence[Any]) -> None:
        if frames:
            write("".join([format_frame(t_ns, names[bus], f) + "\n" for f in frames]))

    begin = RealTime()
    with stopping() as stop:
        simulated_ns = lockstep(cell, host, rig.sync_period_us * 1000, tap, stop.is_set, list(wire.values()) or None)
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


def emulate_on_buses(
    rig_name: str,
    moved: Sequence[str],
    duration: float | None,
    seed: int | None,
    effects: Sequence[str],
    faults: Sequence[str],
    timing: str,
) -> None:
    from emulator import bustiming
    from emulator.bus import open_bus
    from emulator.cell import CellServer
    from emulator.hubprocess import HubProcess
    from emulator.priority import real_time
    from emulator.shell import emulate as run
    from protocols.clock import RealClock

    rig, robot = load(rig_name, moved)
    report_loads(rig)
    wires = bustiming.served(rig, timing, faults)
    arm = emulated(rig, robot, rig_name, seed, effects)
    schedule(arm, faults)
    scratch = emulated(rig, robot, rig_name, seed, effects)
    scratch.plant.advance(*idle(robot.joints))  # compiles what is not cached yet, before anyone relies on the rig
    with ExitStack() as stack:
        served = [(b.name, b.channel) for b in rig.bus if b.interface == "virtualcan"]
        channels = stack.enter_context(HubProcess(served, wires)).channels if served else {}
        opened = [msgspec.structs.replace(b, channel=channels.get(b.name, b.channel)) for b in rig.bus]
        buses = [stack.enter_context(open_bus(b)) for b in opened]
        stop = stack.enter_context(stopping())
        cell = None if rig.cell is None else CellServer(rig.cell, arm.cell())
        if cell is not None:
            cell.start()
            stack.callback(cell.stop)
        places = ", ".join(f"{b.name} {b.interface}:{b.channel}" for b in opened)
        log(f"{rig.name} is running on {places}" + (f", cell on {rig.cell.host}:{rig.cell.port}" if rig.cell else ""))
        real_time()
        run(arm, buses, RealClock(), stop, duration, None if cell is None else lambda: cell.update(arm.cell()))
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
    from emulator.priority import real_time
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
        log(f"moving {cell.name}: {motion}")
        if not real_time():
            log("real-time priority is not allowed here; cycles may be late")
        print(run(host, buses, RealClock(), stop, cell.sync_period_us * 1000))


@app.command()
def check(rig: RigFile, bus: BusOption = None) -> None:
    """Check a rig file and its robot, and print the rig with every default; bus loads go to stderr."""
    from protocols import config

    cell, _ = load(rig, bus)
    report_loads(cell)
    print(config.to_toml(cell), end="")


@app.command()
def hub(rig: RigFile) -> None:
    """Serve the virtualcan buses of a rig by themselves; `armrig emulate` does so by default."""
    from emulator.hub import serve as serve_hub

    cell, _ = load(rig)
    served = [(b.name, b.channel) for b in cell.bus if b.interface == "virtualcan"]
    serve_hub(served, lambda channels: log("hub is running on " + ", ".join(f"{n} {c}" for n, c in channels.items())))


# --- recordings ---


@app.command()
def record(
    rig: RigFile,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="RUN.mcap", help="Recording to write.")],
    bus: BusOption = None,
    duration: DurationOption = None,
    until_quiet: Annotated[
        float | None, typer.Option(metavar="S", min=0.0, help="Stop when SYNC has been there and then missing so long.")
    ] = None,
    offer: Annotated[
        bool, typer.Option(help="Afterwards offer the recording over Zenoh until Ctrl-C, for `armrig request`.")
    ] = False,
    connect: Annotated[str | None, typer.Option(metavar="EP", help="Zenoh endpoint; the rig file's otherwise.")] = None,
) -> None:
    """Listen to a rig and record every frame, the decoded cycles and the cell. Never transmits on CAN.

    Ends with Ctrl-C, after --duration, or when the motion is over (--until-quiet); the file is complete either way.
    """
    from daq.recorder import Recorder
    from daq.shell import Quiet, Writer, record_pipe
    from daq.shell import record as run
    from protocols.clock import RealClock, utc_now_ns
    from protocols.dictionary import drive_dictionary
    from protocols.eds import eds

    cell, robot = load(rig, None if bus == PIPE else bus)
    names = [b.name for b in cell.bus]
    sheets = {f"{j.name}.eds": eds(drive_dictionary(j.drive), f"{j.name}.eds") for j in robot.joint}
    with ExitStack() as stack:
        stop = stack.enter_context(stopping())
        clock = RealClock()
        listeners = [] if bus == PIPE else open_listeners(cell, clock, stack)
        recorder = Recorder(
            output, cell, robot, sheets, created_utc_ns=utc_now_ns(), seed=cell.emulated.seed if bus == PIPE else None
        )
        writer = Writer(recorder, names)
        writer.start()
        log(f"recording {output}")
        try:
            if bus == PIPE:
                record_pipe(writer, sys.stdin.buffer, names, stop.is_set)
            else:
                start_poller(cell, clock, writer, stack)
                run(writer, listeners, clock, stop, duration, Quiet(until_quiet))
        finally:
            summary = writer.finish()
        stop.clear()
        report_recording(summary)
        if offer:
            offer_log(summary.path, connect or cell.zenoh.endpoint, stop)


def open_listeners(rig: "Rig", clock: Any, stack: ExitStack) -> list[Any]:
    from daq.bus import open_listener

    return [stack.enter_context(open_listener(b, clock)) for b in rig.bus]


def start_poller(rig: "Rig", clock: Any, writer: Any, stack: ExitStack) -> None:
    from daq.cell import CellPoller

    if rig.cell is not None:
        poller = CellPoller(rig.cell, clock, writer.put)
        poller.start()
        stack.callback(poller.stop)


def report_recording(summary: Any) -> None:
    """The closing line of a recording.

    Raises:
        DataError: The disk refused; what was written before is kept.
    """
    from protocols.errors import DataError

    print(
        f"{summary.path}: {summary.seconds:.1f} s, {summary.frames} frames, {summary.cycles} cycles, {summary.verdict}"
    )
    for reason in summary.because:
        print(f"  {reason}")
    if summary.failure is not None:
        raise DataError(f"the recording is not complete: {summary.failure} `armrig recover` keeps what there is.")


def offer_log(path: Path, endpoint: str, stop: threading.Event) -> None:
    from daq.serve import LogServer

    with LogServer(endpoint, [path]) as server:
        log(f"offered as {', '.join(server.keys)} at {endpoint}; Ctrl-C ends it")
        stop.wait()


@app.command()
def info(
    recordings: Recordings,
    json: JsonOption = None,
) -> None:
    """What recordings hold: duration, rates, verdict, robot, versions, events."""
    from daq.describe import describe, text

    found = [describe(Path(r)) for r in recordings]
    if json != "-":
        print("\n\n".join(text(d) for d in found))
    write_json(found[0] if len(found) == 1 else found, json)


@app.command()
def recover(
    broken: Annotated[Path, typer.Argument(metavar="BROKEN.mcap", help="Truncated or damaged recording.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="RUN.mcap", help="Readable recording to write.")],
) -> None:
    """Save what can be read of a truncated or damaged recording, and say what is missing."""
    from daq.recover import recover as run

    print(run(broken, output))


@app.command()
def export(
    recording: Annotated[Path, typer.Argument(metavar="RUN.mcap")],
    to: Annotated[
        Path, typer.Option(metavar="FILE", help="run.csv, run.npz, run.parquet, or run.log for candump text.")
    ],
) -> None:
    """Write a recording's signals as a table, units in the column names, or its frames as candump text."""
    from daq.export import export as run

    print(run(recording, to))


# --- identification ---

MethodOption = Annotated[
    str,
    typer.Option("--method", metavar="M[,M...]", help="ols, wls, iv, cloe, didim, irls, tls, ml, ekf, setmembership."),
]
ValidateOption = Annotated[
    list[str] | None, typer.Option("--validate", metavar="RUN.mcap", help="Recording to judge by, not to fit.")
]
RobotOption = Annotated[
    str | None, typer.Option("--robot", metavar="ROBOT.toml", help="Replaces the robot file inside the recordings.")
]
TruthOption = Annotated[
    str | None,
    typer.Option(metavar="ROBOT.toml", help="Known parameters, such as an emulated machine's: shown, never used."),
]
HtmlOption = Annotated[str | None, typer.Option("--html", metavar="FILE", help="Report.")]
ModelOption = Annotated[
    str | None, typer.Option("--model-out", metavar="ROBOT2.toml", help="Robot file with the identified parameters.")
]


@app.command()
def identify(
    recordings: Recordings,
    robot: RobotOption = None,
    method: MethodOption = "wls",
    validate: ValidateOption = None,
    truth: TruthOption = None,
    simulate: Annotated[bool, typer.Option(help="Also simulate the closed loop with every estimate.")] = False,
    covariance: Annotated[
        str, typer.Option(help="Of the standard deviations: white, hac, period, montecarlo.")
    ] = "hac",
    no_filter: Annotated[bool, typer.Option("--no-filter", help="Neither filter positions nor decimate.")] = False,
    json: JsonOption = None,
    html: HtmlOption = None,
    model_out: ModelOption = None,
) -> None:
    """Dynamic parameters of recordings, here and now."""
    from ident.contract import to_json
    from ident.identify import Settings
    from ident.identify import identify as run
    from ident.recorded import signals
    from ident.report import render
    from ident.service import model_file
    from protocols.recording import read_recording
    from protocols.robot import load as load_robot

    given = None if robot is None else load_robot(robot)
    runs = [read_recording(Path(r), given) for r in recordings]
    unseen = [read_recording(Path(r), given) for r in validate or []]
    settings = Settings(covariance=covariance, simulate=simulate)
    if no_filter:
        settings = replace(settings, filter_Hz=math.inf, decimate_to_Hz=math.inf)
    with progress() as told:
        found = run(
            [signals(r) for r in runs],
            runs[0].robot,
            methods_of(method),
            [signals(r) for r in unseen],
            settings,
            truth=known_parameters(truth),
            progress=told,
        )
    deliver(
        json,
        html,
        model_out,
        to_json([i.result for i in found]),
        render(found).encode() if html else b"",
        model_file(found[0]).encode() if model_out else b"",
    )


def methods_of(text: str) -> "list[Method]":
    """Methods of `--method`.

    Raises:
        ConfigError: One of them is unknown.
    """
    from protocols.messages import METHODS, Method

    try:
        return msgspec.convert(text.split(","), list[Method])
    except msgspec.ValidationError:
        raise ConfigError(f"--method {text}: choose from {', '.join(METHODS)}, separated by commas.") from None


def known_parameters(robot_file: str | None) -> dict[str, float]:
    """Base parameters of a `--truth` file by name; none without one."""
    from ident.identify import truth_values
    from protocols.robot import load as load_robot

    if robot_file is None:
        return {}
    machine = load_robot(robot_file)
    return truth_values(machine, machine)


def deliver(
    json: str | None, html: str | None, model_out: str | None, result: bytes, report: bytes, model: bytes
) -> None:
    """An identification to where the user wants it; a table on stdout unless JSON goes there."""
    from ident.contract import from_json
    from ident.printout import show

    if json == "-":
        sys.stdout.write(result.decode())
    else:
        show(from_json(result))
        if json:
            Path(json).write_bytes(result)
    for destination, data in ((html, report), (model_out, model)):
        if destination:
            Path(destination).write_bytes(data)
            log(f"written: {destination}")


ConnectOption = Annotated[str, typer.Option("--connect", metavar="EP", help="Zenoh endpoint of the service.")]
ENDPOINT = "tcp/127.0.0.1:7447"


@app.command()
def explain(
    recordings: Recordings,
    robot: RobotOption = None,
    validate: ValidateOption = None,
    json: JsonOption = None,
    model_out: ModelOption = None,
) -> None:
    """What physics the robot file leaves out: where, how sure, and how much better it predicts unseen motion."""
    from ident.explain.contract import to_json
    from ident.explain.explain import explain as run
    from ident.explain.printout import render
    from ident.explain.recorded import runs as sessions
    from protocols import config
    from protocols.recording import read_recording
    from protocols.robot import load as load_robot

    given = None if robot is None else load_robot(robot)
    seen = [read_recording(Path(r), given) for r in recordings]
    unseen = [read_recording(Path(r), given) for r in validate or []]
    with progress() as told:
        answer = run(sessions(seen), seen[0].robot, sessions(unseen), progress=told)
    if json == "-":
        sys.stdout.write(to_json(answer.explanation).decode())
    else:
        print(render(answer.explanation))
        if json:
            Path(json).write_bytes(to_json(answer.explanation))
    if model_out:
        Path(model_out).write_text(config.to_toml(answer.robot))
        log(f"written: {model_out}")


@app.command()
def compare(
    recording: Annotated[Path, typer.Argument(metavar="RUN.mcap")],
    robots: Annotated[list[str], typer.Argument(metavar="ROBOT_A.toml ROBOT_B.toml...")],
    json: JsonOption = None,
) -> None:
    """Which robot file describes a recorded machine better: as inverse model and simulated in closed loop."""
    from ident.compare import compare as run
    from ident.compare import show, to_json
    from protocols.robot import load as load_robot

    found = run(recording, [(Path(name).stem, load_robot(name)) for name in robots])
    if json == "-":
        sys.stdout.write(to_json(found).decode())
        return
    show(found)
    if json:
        Path(json).write_bytes(to_json(found))


@app.command()
def serve(
    listen: Annotated[str, typer.Option(metavar="EP", help="Zenoh endpoint to listen on.")] = ENDPOINT,
) -> None:
    """Run the identification service until Ctrl-C."""
    from importlib.metadata import version

    from ident.zenoh_service import ZenohService

    with stopping() as stop, closing(ZenohService(listen, version("armrig"), log)):
        log(f"identification service is running at {listen}")
        stop.wait()


@app.command()
def schema() -> None:
    """JSON Schema of every message that the service and the log server exchange."""
    from protocols.messages import json_schema

    sys.stdout.write(msgspec.json.format(msgspec.json.encode(json_schema()), indent=2).decode() + "\n")


request_app = typer.Typer(no_args_is_help=True, help="Ask a service.")
app.add_typer(request_app, name="request")


@request_app.command("identify")
def request_identify(
    recordings: Annotated[list[str], typer.Argument(metavar="RUN.mcap|LOG-KEY...", help="Files, or logs on offer.")],
    connect: ConnectOption = ENDPOINT,
    robot: RobotOption = None,
    method: MethodOption = "wls",
    validate: Annotated[list[str] | None, typer.Option("--validate", metavar="RUN.mcap|LOG-KEY")] = None,
    truth: TruthOption = None,
    json: JsonOption = None,
    html: HtmlOption = None,
    model_out: ModelOption = None,
) -> None:
    """Dynamic parameters of recordings, computed by a service."""
    parts = {"html": bool(html), "model": bool(model_out)}
    answer = ask(recordings, validate or [], connect, robot, method, known_parameters(truth), **parts)
    deliver(json, html, model_out, answer["result"], answer.get("html", b""), answer.get("model", b""))


def ask(
    runs: Sequence[str],
    validation: Sequence[str],
    endpoint: str,
    robot: str | None,
    method: str,
    truth: dict[str, float],
    *,
    html: bool,
    model: bool,
) -> dict[str, bytes]:
    """Parts of a service's answer by name.

    Raises:
        ArmrigError: As `ident.zenoh_client.request`.
    """
    from ident.zenoh_client import request
    from protocols import config, messages
    from protocols.robot import load as load_robot

    references, body = refer([*runs, *validation])
    wanted = messages.IdentifyRequest(
        id=uuid.uuid4().hex,
        methods=methods_of(method),
        runs=references[: len(runs)],
        validation=references[len(runs) :],
        robot_toml=None if robot is None else config.to_toml(load_robot(robot)),
        html=html,
        model=model,
        truth=truth,
    )
    with progress() as told:
        return request(endpoint, wanted, body, told).parts


def refer(names: Sequence[str]) -> "tuple[list[Attached | Logged], bytes]":
    """Recordings of a request: files by their bytes, everything else as a log key.

    Raises:
        ConfigError: Neither a file nor a possible key.
    """
    from protocols import messages

    references: list[messages.Attached | messages.Logged] = []
    body = b""
    for name in names:
        path = Path(name)
        if path.is_file():
            data = path.read_bytes()
            references.append(messages.Attached(name=path.name, bytes=len(data), sha256=messages.sha256(data)))
            body += data
        elif messages.is_log_id(name):
            references.append(messages.Logged(log=name))
        else:
            raise ConfigError(f"{name}: no such file, and no log key either (letters, digits, - and _).")
    return references, body


@contextmanager
def progress() -> Iterator[Callable[[float, str], None]]:
    """How far long work is: a bar on a terminal, plain lines elsewhere."""
    if not sys.stderr.isatty():
        yield lambda fraction, stage: log(f"{100 * fraction:3.0f} % {stage}")
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda fraction, stage: bar.update(task, completed=fraction, description=stage)


# --- the whole chain ---


@app.command()
def demo(
    robot: Annotated[str, typer.Option(help="tx40 or emps.")] = "tx40",
    out: Annotated[Path, typer.Option(metavar="DIR", help="Recordings, logs, result and report go here.")] = Path(
        "armrig-demo"
    ),
    clock: Annotated[str, typer.Option(help="real, or sim: as fast as the CPU allows.")] = "real",
    effect: EffectOption = None,
) -> None:
    """Emulate, drive, record and identify an arm with four processes over CAN and Zenoh; prints the report's path.

    One motion is identified, another is predicted. The true parameters are known to the emulator only; the report
    sets them beside the identified ones.
    """
    from emulator.demo import Demo

    if clock not in {"real", "sim"}:
        raise ConfigError(f"--clock {clock}: choose real or sim.")
    begin = RealTime()
    with stopping() as stop, Demo(robot, out, stop, log, effect or []) as chain:
        print(chain.run(clock))
    print(f"{out / 'report.html'}   ({begin.seconds:.0f} s in all)")


@app.command()
def doctor(json: JsonOption = None) -> None:
    """What this machine offers: SocketCAN, ports, timer, Zenoh, compiled kernels. Compiles what is missing."""
    from emulator import doctor as rig_doctor
    from ident import doctor as service_doctor

    found = []
    for check in (*rig_doctor.checks(), *service_doctor.checks()):
        found.append(check)
        if json != "-":
            print(f"{'ok  ' if check.ok else 'note'}  {check.name:<20} {check.detail}", flush=True)
    write_json(found, json)


@app.command()
def bench(json: JsonOption = None) -> None:
    """How fast this machine runs armrig, each figure beside a peer in the same run. Quote the ratios."""
    from daq.bench import figures as of_recorder
    from emulator.bench import figures as of_rig
    from ident.bench import figures as of_regressor

    found = []
    for figure in (f for figures in (of_rig, of_recorder, of_regressor) for f in figures()):
        found.append(figure)
        if json != "-":
            ours, peer = f"{figure.value:.3g} {figure.unit}", f"{figure.peer_value:.3g} ({figure.peer})"
            print(f"{figure.name:<28} {ours:>18}   {peer:<34} {figure.ratio:5.1f}x", flush=True)
    write_json(found, json)


if __name__ == "__main__":
    main()
