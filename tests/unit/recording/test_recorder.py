"""The recorder and its reader back to back, refusing disks, unfinished files."""

import errno
import os

import msgspec
import numpy as np
import pytest

from daq.recorder import Recorder
from protocols import nmt, topics
from protocols.errors import DataError
from protocols.frames import EXTENDED, REMOTE, Frame
from protocols.recording import Gap, read_recording
from protocols.rig import Emulated, load_rig
from protocols.topics import CellSample, Event

MS = 1_000_000


def test_what_is_recorded_is_read(wire, record):
    summary = record(wire.cycles(700))
    assert (summary.verdict, summary.cycles, summary.frames, summary.failure) == ("LOSSLESS", 700, 9800, None)
    recording = read_recording(summary.path)
    assert recording.verdict == "LOSSLESS"
    assert recording.gaps == ()
    assert recording.robot == wire.robot
    assert recording.period_s == 0.001
    np.testing.assert_array_equal(recording.cycle, np.arange(1, 701))
    np.testing.assert_allclose(recording.t_s, np.arange(1, 701) * 0.001, atol=1e-12)
    assert recording.drives is not None
    np.testing.assert_array_equal(recording.drives.position_counts, np.arange(1, 701)[:, None] * np.ones(6, int))
    np.testing.assert_array_equal(recording.drives.current_permille, np.ones((700, 1), int) * [1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(recording.drives.counter[-1], [700] * 6)
    np.testing.assert_allclose(
        recording.position_rad, wire.robot.joint_position(recording.drives.position_counts), atol=1e-12
    )
    np.testing.assert_allclose(recording.effort_Nm, wire.robot.joint_torque(recording.current_A()), atol=1e-12)
    assert recording.stretches() == [slice(0, 700)]
    assert not recording.t_s.flags.writeable
    with pytest.raises(AttributeError):
        recording.verdict = "LOSSLESS"  # type: ignore[misc]


def test_bytes_read_as_the_file_does(wire, record):
    path = record(wire.cycles(100)).path
    here = read_recording(path.read_bytes(), name="payload")
    assert here.source == "payload"
    assert here.sha256 == read_recording(path).sha256


def test_the_same_input_gives_the_same_file(wire, record):
    batches = wire.cycles(300)
    assert record(batches, "a.mcap").path.read_bytes() == record(batches, "b.mcap").path.read_bytes()


def test_a_gap_stays_a_gap(wire, record, drop):
    lost = [(bus, frames) for bus, frames in wire.cycles(500)]
    lost = drop(lost, lambda bus, t, f: 200 * MS < t <= 210 * MS)
    lost = drop(lost, lambda bus, t, f: f.can_id == nmt.tpdo_id(1, 2) and t == 300 * MS)
    recording = read_recording(record(lost).path)
    assert recording.verdict == "GAPS(81)"
    assert [(round(g.after_s, 6), *g[1:]) for g in recording.gaps] == [
        (0.200, 10, tuple(wire.robot.joint_names)),
        (0.299, 1, ("joint2",)),
    ]
    assert isinstance(recording.gaps[0], Gap)
    assert recording.stretches() == [slice(0, 200), slice(200, 289), slice(290, 490)]
    assert recording.stretches(least=150) == [slice(0, 200), slice(290, 490)]
    row = 289
    assert np.isnan(recording.position_rad[row]).tolist() == [False, True, False, False, False, False]
    assert np.isnan(recording.effort_Nm[row]).tolist() == [False, True, False, False, False, False]


def test_coupled_axes_are_both_unknown_without_one_drive(wire, record, drop):
    """TX40 wrist: motor 6 turns with joints 5 and 6, so q6 needs both drives, and so does the torque of joint 5."""
    batches = wire.cycles(300)
    gone5 = read_recording(record(drop(batches, lambda b, t, f: f.can_id == 0x185 and t == 200 * MS), "5.mcap").path)
    gone6 = read_recording(record(drop(batches, lambda b, t, f: f.can_id == 0x186 and t == 200 * MS), "6.mcap").path)
    assert np.flatnonzero(np.isnan(gone5.position_rad[199])).tolist() == [4, 5]
    assert np.flatnonzero(np.isnan(gone5.effort_Nm[199])).tolist() == [4]
    assert np.flatnonzero(np.isnan(gone6.position_rad[199])).tolist() == [5]
    assert np.flatnonzero(np.isnan(gone6.effort_Nm[199])).tolist() == [4, 5]


def test_cell_and_events(wire, tmp_path):
    recorder = Recorder(tmp_path / "run.mcap", wire.rig, wire.robot)
    for bus, frames in wire.cycles(50):
        recorder.frames(bus, frames)
    sample = CellSample(20 * MS, (30.0, 31.5, 32.0, 33.0, 34.0, 35.0), 21.5, 48.2, False, True, 7, 9, False)
    recorder.cell(sample)
    recorder.cell(sample._replace(t_ns=70 * MS, stale=True))
    recorder.event(Event(30 * MS, topics.WARNING, "cell", "no answer for 1.0 s"))
    recorder.close()
    recording = read_recording(tmp_path / "run.mcap")
    assert recording.cell is not None
    np.testing.assert_allclose(recording.cell.t_s, [0.02, 0.07])
    np.testing.assert_allclose(recording.cell.motor_temperature_C[0], sample.motor_temperature_C)
    assert recording.cell.stale.tolist() == [False, True]
    assert Event(30 * MS, topics.WARNING, "cell", "no answer for 1.0 s") in recording.events


def test_the_emulated_truth_is_not_in_the_file(wire, tmp_path):
    secret = msgspec.structs.replace(wire.rig, emulated=Emulated(machine="the-hidden-machine", seed=424242))
    recorder = Recorder(tmp_path / "run.mcap", secret, wire.robot)
    recorder.close()
    data = (tmp_path / "run.mcap").read_bytes()
    assert b"hidden" not in data
    assert b"424242" not in data


def test_all_kinds_of_frames_are_kept(wire, record):
    from daq.export import frames

    odd = [Frame(0x1ABCDEF | EXTENDED, b"\1\2"), Frame(0x701 | REMOTE, b"", 4), Frame(0x123), Frame(0x7FF, bytes(8))]
    path = record([("can1", [(k * MS, f) for k, f in enumerate(odd)])]).path
    assert [f for _, batch in frames(path) for _, f in batch] == odd


def test_nothing_recorded_says_what_to_do(record):
    with pytest.raises(DataError, match=r"/drives/cycle is empty: no drive answered a SYNC .*armrig move"):
        read_recording(record([]).path)


def test_full_disk_ends_the_file_and_not_the_run(wire, record, monkeypatch):
    written = 0
    real = os.write

    def write(descriptor, data):
        nonlocal written
        if written > 200_000:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        done = real(descriptor, data[: max(1, len(data) // 2)])  # short writes, as a disk that fills up makes them
        written += done
        return done

    monkeypatch.setattr("daq.disk.os.write", write)
    summary = record(wire.cycles(4000))
    monkeypatch.undo()
    assert summary.verdict == "LOSSLESS"
    assert summary.frames == 56_000
    assert summary.path.suffix == ".part"
    assert summary.failure is not None
    assert "recording stopped, the disk refuses: No space left on device." in summary.failure
    assert f"armrig recover {summary.path} -o {summary.path.with_suffix('')}" in summary.failure
    assert summary.path.stat().st_size < 300_000

    from daq.recover import recover

    recovered = recover(summary.path, summary.path.with_suffix(""))
    assert recovered.lost == ()  # the file ends at a whole record
    assert not recovered.finished
    assert len(read_recording(recovered.path).t_s) > 100


def test_a_second_recorder_of_the_same_file_is_refused(wire, tmp_path):
    first = Recorder(tmp_path / "run.mcap", wire.rig, wire.robot)
    with pytest.raises(DataError, match=r"run.mcap.part: another process is writing this file"):
        Recorder(tmp_path / "run.mcap", wire.rig, wire.robot)
    first.close()
    (tmp_path / "run.mcap").rename(tmp_path / "run.mcap.part")
    with pytest.raises(DataError, match=r"an unfinished recording is in the way. Run armrig recover .*run.mcap.part"):
        Recorder(tmp_path / "run.mcap", wire.rig, wire.robot)
    with pytest.raises(DataError, match="cannot be created: No such file or directory"):
        Recorder(tmp_path / "nowhere" / "run.mcap", wire.rig, wire.robot)


def test_at_most_a_flush_period_is_lost(wire, tmp_path):
    """What is on disk without any closing: kill -9 leaves exactly this."""
    from daq.recover import recover

    recorder = Recorder(tmp_path / "run.mcap", wire.rig, wire.robot)
    for bus, frames in wire.cycles(3777):
        recorder.frames(bus, frames)
    recovered = recover(tmp_path / "run.mcap.part", tmp_path / "saved.mcap")
    assert recovered.lost == ()
    last = read_recording(tmp_path / "saved.mcap").t_s[-1]
    assert last > 3.777 - wire.rig.recorder.flush_ms * 1e-3 - 0.064 - 0.001  # cycles wait 64 ms for latecomers
    recorder.close()


def test_closing_twice_changes_nothing(wire, tmp_path):
    recorder = Recorder(tmp_path / "run.mcap", wire.rig, wire.robot)
    assert recorder.close() is recorder.close()


def test_counts_and_versions_are_in_the_metadata(wire, record):
    rig, _ = load_rig("tx40-rig")
    recording = read_recording(record(wire.cycles(100)).path)
    start, stop = recording.metadata[topics.RUN_START], recording.metadata[topics.RUN_STOP]
    assert start["seed"] == "1"
    assert start["joints"] == "joint1 joint2 joint3 joint4 joint5 joint6"
    assert len(start["sha256:robot.toml"]) == len(start["sha256:joint1.eds"]) == 64
    assert stop["count:/can0/frames"] == "700"
    assert stop["verdict"] == "LOSSLESS"
    assert recording.rig == rig.for_recording()
