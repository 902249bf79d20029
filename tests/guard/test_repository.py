"""What the repository promises about itself."""

import re
import subprocess
from pathlib import Path

import pytest
from typer.main import get_command

import armrig

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
LONGEST = 520  # lines; past this a file does two jobs


def tracked() -> list[Path]:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    return [ROOT / name for name in listed.stdout.split("\0") if name and (ROOT / name).is_file()]


def test_every_command_in_the_readme_exists_with_its_options() -> None:
    root = get_command(armrig.app)
    lines = [c for c in re.findall(r"armrig (\w[\w ]*[^\n`|#]*)", README) if c.split()[0] in root.commands]  # type: ignore[attr-defined]
    assert len(lines) > 10
    for line in lines:
        words = line.split()
        command = root.commands[words[0]]  # type: ignore[attr-defined]
        if words[0] == "request":
            command = command.commands[words[1]]
        known = {option for parameter in command.params for option in parameter.opts}
        used = set(re.findall(r"(?<!\S)(--?[a-z][a-z-]*)", line))
        assert used <= known, f"armrig {line}: {used - known} is unknown"


def test_every_make_target_in_the_readme_exists() -> None:
    targets = set(re.findall(r"^([a-z][\w-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(re.findall(r"(?:`|^)make ([a-z][\w-]*)", README, re.MULTILINE)) <= targets


def test_links_in_the_readme_lead_somewhere() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / target).exists(), target


def test_no_file_has_grown_beyond_one_job() -> None:
    long = {
        str(path.relative_to(ROOT)): lines
        for path in tracked()
        if path.suffix == ".py" and (lines := len(path.read_text().splitlines())) > LONGEST
    }
    assert set(long) <= {"armrig.py"}, "the composition root is a list of commands; everything else has one job"


def test_nothing_names_this_machine() -> None:
    """Neither where the checkout lies nor whose it is; wherever the test runs."""
    # A checkout right under the root has a name too short to mean anything in a text.
    places = [str(place) for place, least in ((ROOT, 3), (Path.home(), 2)) if len(place.parts) >= least]
    pattern = re.compile("|".join(re.escape(place) + r"/" for place in places) + r"|/home/\w")
    found = [
        f"{path.relative_to(ROOT)}: {line.strip()[:100]}"
        for path in tracked()
        if path != Path(__file__)
        for line in path.read_text(errors="ignore").splitlines()
        if pattern.search(line)
    ]
    assert not found


def test_the_lock_file_holds_hashes_and_no_addresses() -> None:
    lock = (ROOT / "requirements.lock").read_text()
    assert "--hash=sha256:" in lock
    assert "://" not in lock


def test_no_recording_is_kept_in_the_repository() -> None:
    assert not [p for p in tracked() if p.suffix in {".mcap", ".csv", ".parquet", ".npz"} and p.stat().st_size > 50_000]
