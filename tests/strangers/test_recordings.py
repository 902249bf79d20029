"""Recordings of an emulated motion, read by programs that share no code with armrig.

Validators run under a memory limit: on damaged files one was seen to take 24 GB.
"""

import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from daq.recorder import Recorder
from daq.recover import recover
from emulator.host import Host
from emulator.lockstep import lockstep
from emulator.machine import load_machine
from emulator.rig import EmulatedRig
from protocols.dictionary import drive_dictionary
from protocols.eds import eds
from protocols.motion import Motion, Standstill
from protocols.recording import read_recording
from protocols.rig import load_rig
from protocols.topics import CellSample

pytestmark = pytest.mark.stranger
MEMORY_BYTES = 4 << 30
NODE = Path(__file__).parent / "node"


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    """Approach and standstill of the TX40 in simulated time, with every topic in the file."""
    rig, robot = load_rig("tx40-rig")
    machine = load_machine(rig, robot)
    path = tmp_path_factory.mktemp("strangers") / "run.mcap"
    sheets = {f"{j.name}.eds": eds(drive_dictionary(j.drive), f"{j.name}.eds") for j in robot.joint}
    recorder = Recorder(path, rig, robot, sheets, created_utc_ns=1_760_000_000_000_000_000, seed=1)
    names = [b.name for b in rig.bus]
    lockstep(
        EmulatedRig(rig, machine),
        Host(rig, robot, Motion(name="short", approach_s=1.0, segment=[Standstill(duration_s=0.5)])),
        rig.sync_period_us * 1000,
        lambda t_ns, bus, frames: recorder.frames(names[bus], [(t_ns, f) for f in frames]),
    )
    recorder.cell(CellSample(10**9, (30.0,) * 6, 21.0, 48.0, False, True, 1, 2, False))
    assert recorder.close().verdict == "LOSSLESS"
    return path


@pytest.fixture(scope="module")
def recovered(path, tmp_path_factory) -> Path:
    """The same, cut off and recovered."""
    folder = tmp_path_factory.mktemp("recovered")
    (folder / "cut.mcap").write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    return recover(folder / "cut.mcap", folder / "run.mcap").path


def run(*command: str, **options: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, **options)  # type: ignore[call-overload,no-any-return]


def limit_memory() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))


@pytest.mark.parametrize("which", ["path", "recovered"])
def test_pymcap_cli_doctor(which, request):
    program = Path(sys.executable).parent / "pymcap-cli"
    if not program.exists():
        pytest.skip("pymcap-cli is not installed")
    done = run(str(program), "doctor", str(request.getfixturevalue(which)), preexec_fn=limit_memory)
    assert done.returncode == 0, done.stdout + done.stderr


def test_pymcap_cli_doctor_does_find_damage(path, tmp_path):
    """Negative control."""
    program = Path(sys.executable).parent / "pymcap-cli"
    if not program.exists():
        pytest.skip("pymcap-cli is not installed")
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:-5000])
    done = run(str(program), "doctor", str(tmp_path / "cut.mcap"), preexec_fn=limit_memory)
    assert done.returncode != 0


@pytest.mark.parametrize("which", ["path", "recovered"])
def test_rosbags_reads_every_message(which, request):
    path = request.getfixturevalue(which)
    ours = read_recording(path)
    counts: dict[str, int] = {}
    cycles, positions = [], []
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, _t_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
            if connection.topic == "/drives/cycle":
                cycles.append((message.cycle, *message.position_counts))
            elif connection.topic == "/joint_states":
                positions.append(message.position)
    assert ours.drives is not None
    np.testing.assert_array_equal(np.array(cycles)[:, 0], ours.cycle)
    np.testing.assert_array_equal(np.array(cycles)[:, 1:], ours.drives.position_counts)
    assert abs(len(positions) - len(cycles)) <= 250  # where the file was cut, one topic may reach a flush farther
    common = min(len(positions), len(cycles))
    np.testing.assert_allclose(np.array(positions)[:common], ours.position_rad[:common], atol=1e-15)
    if which == "path":
        stop = ours.metadata["RunStop"]
        assert counts == {
            k.removeprefix("count:"): int(n) for k, n in stop.items() if k.startswith("count:") and n != "0"
        }


@pytest.fixture(scope="module")
def node_reader(tmp_path_factory) -> Path:
    """The JavaScript reader with its packages, pinned by the lock file."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("node or npm is not installed")
    folder = tmp_path_factory.mktemp("node")
    for name in ("package.json", "package-lock.json", ".npmrc", "read.mjs"):
        shutil.copy(NODE / name, folder)
    done = run("npm", "ci", "--no-audit", "--no-fund", "--ignore-scripts", cwd=folder, env=os.environ | {"CI": "1"})
    if done.returncode != 0:
        pytest.skip(f"npm could not fetch the packages: {done.stderr.strip().splitlines()[-1][:200]}")
    return folder / "read.mjs"


@pytest.mark.parametrize("which", ["path", "recovered"])
def test_the_reader_of_foxglove(which, request, node_reader):
    path = request.getfixturevalue(which)
    ours = read_recording(path)
    done = run("node", str(node_reader), str(path))
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["profile"] == "ros2"
    topics = found["topics"]
    assert topics["/can1/frames"]["type"] == "can_msgs/msg/Frame"
    assert topics["/drives/cycle"]["messages"] == len(ours.cycle)
    last = topics["/joint_states"]["last"]
    assert last["name"] == ours.robot.joint_names
    row = round(last["header"]["stamp"]["sec"] * 1000 + last["header"]["stamp"]["nanosec"] * 1e-6) - ours.cycle[0]
    if which == "path":
        assert row == len(ours.cycle) - 1
    if row < len(ours.cycle):  # where the file was cut, one topic may reach farther than another
        np.testing.assert_allclose(last["position"], ours.position_rad[row], atol=1e-15)
        np.testing.assert_allclose(last["effort"], ours.effort_Nm[row], atol=1e-12)
    assert topics["/drives/cycle"]["last"]["cycle"] == ours.cycle[-1]
    assert topics["/drives/cycle"]["last"]["missing"] == [False] * 6
    assert found["metadata"]["RunStart"]["created_utc"] == "2025-10-09T08:53:20+00:00"
    assert sorted(found["attachments"]) == sorted(["robot.toml", "rig.toml", *(f"joint{k}.eds" for k in range(1, 7))])
    if which == "path":
        assert topics["/cell/io"]["last"]["supply_v"] == 48.0
        assert topics["/rig/integrity"]["last"]["verdict"] == "LOSSLESS"
