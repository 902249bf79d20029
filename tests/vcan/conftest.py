"""Tests that need kernel SocketCAN (marker `vcan`) run where it is, all in one go, and report here one by one.

Where the kernel offers vcan: in a network namespace of their own. Else through the program that VCAN_RUN names, which
runs a command where vcan0 and vcan1 are up. Else they are skipped. Processes are dear there, so one pytest runs all.
"""

import contextlib
import functools
import json
import os
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

REPORTS = "ARMRIG_VCAN_REPORTS"  # set inside: where outcomes go
TIMEOUT_S = 900
MISSING = (
    "no kernel vcan: sudo modprobe vcan, or set VCAN_RUN to a program that runs a command where vcan0 and vcan1 are"
)
NAMESPACE = (
    "ip link set lo up && for i in vcan0 vcan1; do ip link add $i type vcan && ip link set $i up || exit; done && exec"
    ' "$@"'
)


def native() -> list[str] | None:
    """Command that runs another with vcan0 and vcan1 of the kernel's own; None where it has none."""
    unshare = ["unshare", "-n"] if os.geteuid() == 0 else ["unshare", "-rn"]
    if not (shutil.which("unshare") and shutil.which("ip")):
        return None
    probe = [*unshare, "ip", "link", "add", "vcanprobe", "type", "vcan"]
    if subprocess.run(probe, capture_output=True, check=False).returncode:
        return None
    with contextlib.suppress(OSError), socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW):
        return [*unshare, "sh", "-c", NAMESPACE, "sh"]
    return None


def launcher() -> list[str] | None:
    """How to run a command where vcan0 and vcan1 are up."""
    program = os.environ.get("VCAN_RUN")
    return native() or ([program, "--timeout", str(TIMEOUT_S), "--"] if program else None)


class Elsewhere(pytest.Item):
    """A test that has run, or will, where vcan is."""

    selected: tuple[str, ...] = ()

    def runtest(self) -> None:
        if launcher() is None:
            pytest.skip(MISSING)
        outcomes, said = run_all(self.selected, self.config.rootpath)
        if self.nodeid not in outcomes:
            raise AssertionError(f"it did not get to run; all that was said:\n{said}")
        outcome, text = outcomes[self.nodeid]
        if outcome == "skipped":
            pytest.skip(text)
        if outcome == "failed":
            raise AssertionError(text)

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException]) -> str:
        return str(excinfo.value)

    def reportinfo(self) -> tuple[Path, None, str]:
        return self.path, None, self.name


@functools.cache
def run_all(selected: tuple[str, ...], root: Path) -> tuple[dict[str, tuple[str, str]], str]:
    """Outcome and words of each test by its name, and all that pytest said."""
    reports = root / ".pytest_cache" / f"vcan-{os.getpid()}.jsonl"
    reports.parent.mkdir(exist_ok=True)
    environment = os.environ | {REPORTS: str(reports), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [*(launcher() or []), sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-q", *selected]
    done = subprocess.run(
        command, cwd=root, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False
    )
    outcomes: dict[str, tuple[str, str]] = {}
    if reports.exists():
        for line in reports.read_text().splitlines():
            name, outcome, text = json.loads(line)
            if outcomes.get(name, ("passed",))[0] == "passed":
                outcomes[name] = outcome, text
        reports.unlink()
    return outcomes, f"{done.stdout.decode(errors='replace')}\n(exit code {done.returncode})"


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if REPORTS in os.environ:
        config.pluginmanager.register(Reporter(Path(os.environ[REPORTS])))
        return
    selected = tuple(item.nodeid for item in items if item.get_closest_marker("vcan"))
    for k, item in enumerate(items):
        if item.nodeid in selected and item.parent is not None:
            items[k] = Elsewhere.from_parent(item.parent, name=item.name)
            items[k].selected = selected
            items[k].add_marker("vcan")
            items[k].add_marker(pytest.mark.timeout(TIMEOUT_S))


class Reporter:
    """Writes down how each test inside has ended; a plugin, since a conftest hears of its own folder alone."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" or not report.passed:
            text = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longreprtext
            with self._path.open("a") as file:
                file.write(json.dumps([report.nodeid, report.outcome, text]) + "\n")


# --- inside ---


@pytest.fixture(scope="session")
def virtual_time() -> bool:
    """Whether computing takes no time here: then everything repeats exactly."""
    begin = time.monotonic()
    sum(range(1_000_000))
    return time.monotonic() - begin < 1e-3
