"""A minute in real time: is a frame lost, is a cycle late, what does the recorder cost?

Emulator, hub, host and recorder are processes of their own on two buses, six drives at 1 kHz both ways.

Run: make soak, or python tests/studies/soak.py SECONDS
"""

import json
import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import msgspec

from emulator.child import Child
from emulator.demo import on_free_ports
from protocols import config
from protocols.motion import Fourier, Motion
from protocols.rig import load_rig


def longer(plan: Motion, seconds: float) -> Motion:
    """The motion with as many whole periods as fit."""
    series = plan.segment[0]
    if not isinstance(series, Fourier):
        raise TypeError(f"{plan.name} is not periodic")
    periods = max(1, int((seconds - 2 * plan.approach_s) * series.base_Hz))
    return msgspec.structs.replace(plan, segment=[msgspec.structs.replace(series, periods=periods)])


def cpu_s(pid: int) -> float:
    """User and system time of a living process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    stop = threading.Event()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rig = on_free_ports(load_rig("tx40-rig")[0])
        (folder / "rig.toml").write_text(config.to_toml(rig))
        plan = longer(config.read(config.locate("tx40-train"), Motion), seconds)
        (folder / "motion.toml").write_text(config.to_toml(plan))
        rig_file, run = str(folder / "rig.toml"), folder / "soak.mcap"
        with Child(folder / "emulate.log", ("emulate", rig_file), stop) as emulator:
            emulator.wait_for("is running")
            with Child(folder / "record.log", ("record", rig_file, "-o", str(run), "--until-quiet", "1"), stop) as daq:
                daq.wait_for("recording")
                before = cpu_s(daq.pid)
                move = ("move", rig_file, "--motion", str(folder / "motion.toml"))
                with Child(folder / "move.log", move, stop) as host:
                    print("host:    ", host.finish().strip())
                recorder_s = cpu_s(daq.pid) - before
                daq.finish()
        info = subprocess.run(
            [sys.executable, "-m", "armrig", "info", str(run), "--json", "-"], capture_output=True, check=True
        )
        about = json.loads(info.stdout)
        frames = sum(t["messages"] for topic, t in about["topics"].items() if topic.endswith("/frames"))
        print(f"recorder: {about['cycles']} cycles, {frames} frames in {about['seconds']:.1f} s,", about["verdict"])
        rate, share = frames / about["seconds"], 100 * recorder_s / about["seconds"]
        print(f"          {rate:.0f} frames/s at {share:.0f} % of a core")
        raise SystemExit(about["verdict"] != "LOSSLESS")


if __name__ == "__main__":
    main()
