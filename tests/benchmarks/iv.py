"""Time of the methods that simulate, on 10 s of TX40 data recorded through the full chain.

python tests/benchmarks/iv.py: processor seconds after one warm run, so that other work on the machine does not count;
reading the reference from the recording's frames apart. One BLAS thread: two on small matrices wait for each other.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is imported

import tempfile
from collections.abc import Callable
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from daq.recorder import Recorder
from emulator.host import Host
from emulator.lockstep import lockstep
from emulator.machine import load_machine
from emulator.rig import EmulatedRig
from ident import auxiliary
from ident.base import base_parameters
from ident.cloe import Cloe
from ident.dataset import prepare
from ident.didim import Didim
from ident.estimate import Estimate, LeastSquares
from ident.iv import IdimIv
from ident.model import Model
from ident.observation import observe
from ident.problem import Estimator, Problem
from ident.recorded import signals
from protocols import config
from protocols.motion import Motion
from protocols.recording import read_recording
from protocols.rig import load_rig
from protocols.targets import read_targets

REPEATS = 3


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Processor time, best of some runs after a warm one [s], and the result."""
    result, best = call(), np.inf
    for _ in range(REPEATS):
        start = process_time()
        result = call()
        best = min(best, process_time() - start)
    return best, result


def main() -> None:
    rig, robot = load_rig("tx40-rig")
    plan = config.read(config.locate("tx40-test"), Motion)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        recorder = Recorder(path, rig, robot, seed=401)
        buses = [b.name for b in rig.bus]
        lockstep(
            EmulatedRig(rig, load_machine(rig, robot)),
            Host(rig, robot, plan),
            rig.sync_period_us * 1000,
            lambda t_ns, bus, frames: recorder.frames(buses[bus], [(t_ns, f) for f in frames]),
        )
        recorder.close()
        reading, recording = timed(lambda: read_recording(path))
        frames, _ = timed(lambda: read_targets(recording))
        run = signals(recording)
        model = Model.of(robot)
        base = base_parameters(model)
        preparing, dataset = timed(lambda: prepare(run))
        observing, rows = timed(lambda: observe(dataset, model, base))
        problem = Problem(model, base, [run], [dataset], [rows], 50.0, None)
        runs = auxiliary.runs([run])
        theta = model.theta(robot)
        simulating, _ = timed(lambda: auxiliary.simulate(runs, model, theta, update_gains=True))
        print(f"{recording.t_s[-1]:.1f} s at 1 kHz, {model.joints} joints, {len(base.names)} base parameters")
        print(f"read cycles {reading:.2f} s, read the reference from raw frames {frames:.2f} s")
        print(f"filter {preparing:.3f} s, rows {observing:.3f} s, one simulation {simulating:.3f} s")
        methods: list[Estimator] = [LeastSquares(weighted=True), IdimIv(), Didim(), Cloe()]
        for method in methods:
            seconds, found = timed(lambda method=method: method.fit(problem))  # type: ignore[misc]
            estimate: Estimate = found
            each = f", {seconds / estimate.iterations:.2f} s each" if estimate.iterations > 1 else ""
            print(f"{method.name}: {seconds:.2f} s, {estimate.iterations} iterations{each}")


if __name__ == "__main__":
    main()
