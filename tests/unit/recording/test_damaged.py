"""Truncated, flipped and hostile files: a sentence that says what to do, never a hang, never a wrong number."""

import struct
import tracemalloc

import numpy as np
import pytest
import zstandard

from daq.describe import describe
from daq.export import export
from daq.recover import recover
from protocols.errors import ArmrigError, ConfigError, DataError
from protocols.recording import read_recording
from protocols.robot import load


@pytest.fixture
def small(wire, record) -> bytes:
    """A short but complete recording."""
    return record(wire.cycles(12)).path.read_bytes()


def test_truncated_at_every_byte(small, tmp_path):
    broken, saved = tmp_path / "broken.mcap", tmp_path / "saved.mcap"
    recovered = 0
    for size in range(1, len(small), 1 if len(small) < 3000 else 7):
        with pytest.raises(DataError, match=r"is not an MCAP file|armrig recover broken.mcap -o FIXED.mcap"):
            read_recording(small[:size], name="broken.mcap")
        if size % 5 == 0:
            broken.write_bytes(small[:size])
            try:
                recover(broken, saved)
            except DataError as error:
                assert "no message could be recovered" in str(error) or "is not an MCAP file" in str(error)
            else:
                recovered += 1
                describe(saved)
    assert recovered > 50


def test_one_flipped_byte_is_always_noticed(small):
    rng = np.random.default_rng(1)
    for at in rng.choice(len(small), 400, replace=False):
        flipped = bytearray(small)
        flipped[at] ^= 1 << int(rng.integers(8))
        with pytest.raises(DataError):
            read_recording(bytes(flipped), name="flipped.mcap")


def test_recover_loses_only_the_damaged_chunk(wire, record, tmp_path):
    path = record(wire.cycles(3000)).path
    data = bytearray(path.read_bytes())
    offsets = [i for i in range(len(data)) if data[i : i + 8] == b"\4\0\0\0zstd"]
    victim = offsets[len(offsets) // 4]  # the second half are entries of the summary
    data[victim + 40] ^= 0x40  # inside the compressed bytes
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(data)
    whole, found = read_recording(path), recover(broken, tmp_path / "fixed.mcap")
    assert len(found.lost) == 1
    assert found.lost[0].first_s is not None
    assert "cannot be decompressed" in found.lost[0].reason or "wrong checksum" in found.lost[0].reason
    assert found.finished
    fixed = read_recording(found.path)
    assert 0 < len(whole.t_s) - len(fixed.t_s) < 400 or fixed.verdict.startswith("GAPS(")
    assert "lost: bytes" in str(found)
    again = recover(found.path, tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == found.path.read_bytes()
    assert again.lost == ()


def test_recover_of_a_sound_file_changes_no_signal(wire, record, tmp_path):
    path = record(wire.cycles(500)).path
    found = recover(path, tmp_path / "copy.mcap")
    assert (found.lost, found.finished, found.verdict) == ((), True, "LOSSLESS")
    a, b = read_recording(path), read_recording(found.path)
    np.testing.assert_array_equal(a.position_rad, b.position_rad)
    assert a.metadata == b.metadata


def test_recover_judges_the_frames_anew(wire, record, drop, tmp_path):
    path = record(drop(wire.cycles(800), lambda bus, t, f: f.can_id == 0x184 and t == 100_000_000)).path
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    found = recover(tmp_path / "cut.mcap", tmp_path / "fixed.mcap")
    assert found.verdict == "GAPS(1)"
    assert found.because == ("joint4: 1 TPDO1 lost", "the end of the run was not recorded")


def test_recover_refuses_what_makes_no_sense(small, tmp_path):
    path = tmp_path / "x.mcap"
    path.write_bytes(small)
    with pytest.raises(DataError, match="cannot replace the file it is recovered from"):
        recover(path, path)
    with pytest.raises(DataError, match=r"missing.mcap: cannot be read: No such file or directory"):
        recover(tmp_path / "missing.mcap", path)
    (tmp_path / "text").write_text("hello, this is no recording")
    with pytest.raises(DataError, match="is not an MCAP file; there is nothing to recover"):
        recover(tmp_path / "text", tmp_path / "y.mcap")
    assert sorted(p.name for p in tmp_path.iterdir() if "recovering" in p.name) == []


def test_not_a_recording(tmp_path):
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "text").write_text("t,q\n0,1\n")
    with pytest.raises(DataError, match="empty: the file is empty"):
        read_recording(tmp_path / "empty")
    with pytest.raises(DataError, match=r"text is not an MCAP file. Recordings are made with armrig record"):
        read_recording(tmp_path / "text")
    with pytest.raises(DataError, match="cannot be read: No such file"):
        read_recording(tmp_path / "none.mcap")
    with pytest.raises(DataError, match="cannot be read: Is a directory"):
        read_recording(tmp_path)


def test_wrong_robot(wire, record):
    path = record(wire.cycles(20)).path
    with pytest.raises(DataError, match=r"recorded are the joints joint1, .*joint6, but the robot EMPS has .*--robot"):
        read_recording(path, load("emps"))


def test_a_chunk_that_announces_gigabytes_is_refused(small):
    """Decompression bomb: neither the chunk's size nor the zstd frame's is believed."""
    at = small.index(b"\4\0\0\0zstd") - 12  # u64 decompressed size, u32 CRC
    (size,) = struct.unpack_from("<Q", small, at)
    assert size < 1 << 20
    data_end = small.index(struct.pack("<BQ", 0x0F, 4))

    def with_size(value: int) -> bytes:
        data = bytearray(small)
        struct.pack_into("<Q", data, at, value)
        struct.pack_into("<I", data, data_end + 9, 0)  # without the CRC over everything
        return bytes(data)

    tracemalloc.start()
    with pytest.raises(DataError, match="has a chunk of 1099511627776 bytes decompressed, more than"):
        read_recording(with_size(1 << 40), name="bomb.mcap")
    with pytest.raises(DataError, match=r"has a chunk of 33554432 bytes whose zstd frame announces \d+"):
        read_recording(with_size(32 << 20), name="bomb.mcap")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 50e6
    assert zstandard.frame_content_size(zstandard.compress(b"x" * 100)) == 100  # the check has something to compare


def test_export_of_a_damaged_file_leaves_nothing_behind(small, tmp_path):
    (tmp_path / "cut.mcap").write_bytes(small[:-100])
    for suffix in ("csv", "npz", "parquet", "log"):
        with pytest.raises(ArmrigError, match="armrig recover"):
            export(tmp_path / "cut.mcap", tmp_path / f"out.{suffix}")
        assert not (tmp_path / f"out.{suffix}").exists()
    with pytest.raises(ConfigError, match=r"the name must end in .csv, .npz, .parquet or .log"):
        export(tmp_path / "cut.mcap", tmp_path / "out.xlsx")


def test_recover_survives_any_damage(wire, record, tmp_path):
    """Several bytes changed anywhere: what comes out is readable, or the refusal is a sentence."""
    whole = record(wire.cycles(400)).path.read_bytes()
    rng = np.random.default_rng(7)
    refused = 0
    for _ in range(40):
        data = bytearray(whole)
        for at in rng.integers(8, len(data), 6):
            data[at] = int(rng.integers(256))
        (tmp_path / "broken.mcap").write_bytes(data)
        try:
            found = recover(tmp_path / "broken.mcap", tmp_path / "fixed.mcap")
            read_recording(found.path)
        except DataError as error:
            assert str(error).endswith((".", ".mcap."))
            refused += 1
    assert refused < 15  # only where a schema, the robot file or every cycle was hit
