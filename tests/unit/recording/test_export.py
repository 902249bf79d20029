"""Tables and candump text of a recording, read back by others' readers."""

import csv
import shutil
import subprocess

import numpy as np
import pyarrow.parquet
import pytest

from daq.describe import describe, text
from daq.export import export, table
from protocols.candump import parse_line
from protocols.recording import read_recording


@pytest.fixture
def path(wire, record, drop):
    return record(drop(wire.cycles(300), lambda bus, t, f: f.can_id == 0x182 and t == 90_000_000)).path


def test_tables_hold_the_recording(path, tmp_path):
    recording = read_recording(path)
    columns = table(recording)
    assert list(columns)[:7] == [
        "t_s", "cycle", "joint1_position_rad", "joint1_effort_Nm", "joint1_current_A",
        "joint1_position_counts", "joint1_missing",
    ]  # fmt: skip
    said = export(path, tmp_path / "run.npz")
    assert "300 rows of 32 columns: t_s, cycle, joint1_position_rad" in said
    with np.load(tmp_path / "run.npz") as arrays:
        np.testing.assert_array_equal(arrays["joint3_position_rad"], recording.position_rad[:, 2])
        assert arrays["joint2_missing"].sum() == 1
        assert np.isnan(arrays["joint2_effort_Nm"][89])
    export(path, tmp_path / "run.csv")
    with (tmp_path / "run.csv").open() as file:
        rows = list(csv.DictReader(file))
    np.testing.assert_allclose([float(r["t_s"]) for r in rows], recording.t_s)
    np.testing.assert_allclose(
        [float(r["joint6_position_rad"]) for r in rows], recording.position_rad[:, 5], rtol=1e-11
    )
    export(path, tmp_path / "run.parquet")
    read = pyarrow.parquet.read_table(tmp_path / "run.parquet")
    assert read.column_names == list(columns)
    np.testing.assert_array_equal(read["joint1_current_A"].to_numpy(), columns["joint1_current_A"])


def test_candump_text_has_every_frame_in_order(path, wire, tmp_path):
    assert export(path, tmp_path / "run.log").endswith(": 4199 frames")
    lines = [parse_line(line) for line in (tmp_path / "run.log").read_text().splitlines()]
    stamps = [t for t, _, _ in lines]
    assert stamps == sorted(stamps)
    assert [f.can_id for t, bus, f in lines if t == 5_000_000 and bus == "can1"] == [
        0x304, 0x305, 0x306, 0x80, 0x184, 0x185, 0x186,
    ]  # fmt: skip


@pytest.mark.stranger
def test_tshark_reads_the_candump_text(path, tmp_path):
    if shutil.which("tshark") is None:
        pytest.skip("tshark is not installed")
    export(path, tmp_path / "run.log")
    command = ["tshark", "-r", str(tmp_path / "run.log"), "-d", "can.subdissector,canopen"]
    fields = ["-Y", "canopen.sync.counter", "-T", "fields", "-e", "canopen.sync.counter"]
    done = subprocess.run([*command, *fields], capture_output=True, text=True, timeout=60, check=True)
    assert [int(x) for x in done.stdout.split()] == [k % 240 + 1 for k in range(300) for _ in range(2)]


def test_description(path):
    found = describe(path)
    assert found["cycles"] == 300
    assert found["verdict"] == "GAPS(1)"
    assert found["because"] == ["joint2: 1 TPDO1 lost"]
    assert (found["robot"], found["rig"], found["seed"]) == ("TX40", "TX40 rig", 1)
    assert found["topics"]["/can0/frames"]["messages"] == 2099
    assert found["topics"]["/drives/cycle"]["rate_Hz"] == pytest.approx(1000)
    assert found["integrity"]["feedback_lost"] == [0, 1, 0, 0, 0, 0]
    shown = text(found)
    assert "GAPS(1)" in shown
    assert "joint2: 1 TPDO1 lost" in shown
    assert "/joint_states" in shown
