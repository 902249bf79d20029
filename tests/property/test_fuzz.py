"""A short run of the fuzz study, and a drive that lies: the study must notice."""

import runpy
from pathlib import Path

import pytest

from emulator.drive import Drive
from protocols.cia402 import State

STUDY = Path(__file__).parents[1] / "studies" / "fuzz.py"


def test_random_and_mutated_frames() -> None:
    said: list[str] = []
    runpy.run_path(str(STUDY))["fuzz"](120_000, 1, said.append)
    assert "120000 frames" in said[0]


def test_a_drive_that_reports_a_wrong_state_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    update = Drive.update

    def lie(self: Drive) -> None:
        update(self)
        if self.state is State.QUICK_STOP_ACTIVE:
            self.device.store.values[0x6041_00] = 0x0237

    monkeypatch.setattr(Drive, "update", lie)
    with pytest.raises(SystemExit, match="QUICK_STOP_ACTIVE is reported as State.OPERATION_ENABLED"):
        runpy.run_path(str(STUDY))["fuzz"](60_000, 5, print)
