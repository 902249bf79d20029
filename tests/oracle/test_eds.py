"""The drive's data sheet before its readers: dcfchk (dcf-tools 2.4.2, the gate of Lely and ros2_canopen) and
`canopen` 2.4.1."""

import io
import shutil
import subprocess
import sys
from pathlib import Path

import canopen
import pytest
from dcf.device import Device

from protocols.dictionary import drive_dictionary
from protocols.eds import eds
from protocols.objects import Code, Type
from protocols.robot import Drive

DICTIONARY = drive_dictionary(
    Drive(gear_ratio=-32.0, drive_gain_Nm_A=10.5, rated_current_A=2.0, max_current_A=8.0, resistance_Ohm=3.0)
)


def dcfchk(path: Path, node: int) -> subprocess.CompletedProcess[str]:
    program = shutil.which("dcfchk", path=str(Path(sys.executable).parent))
    assert program is not None
    command = [program, "-n", str(node), str(path)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


@pytest.fixture
def sheet(tmp_path: Path) -> Path:
    path = tmp_path / "drive.eds"
    path.write_text(eds(DICTIONARY, path.name), encoding="ascii")
    return path


@pytest.mark.parametrize("node", [1, 127])
def test_dcfchk_accepts_it(sheet: Path, node: int) -> None:
    result = dcfchk(sheet, node)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


@pytest.mark.parametrize(
    ("good", "bad", "complaint"),
    [
        ("DefaultValue=0\nPDOMapping=1", "DefaultValue=x\nPDOMapping=1", "invalid DefaultValue"),
        ("SubNumber=5", "SubNumber=6", "missing sub-object"),
        ("AccessType=rw", "AccessType=maybe", "invalid value for AccessType"),
    ],
)
def test_dcfchk_refuses_a_broken_one(sheet: Path, good: str, bad: str, complaint: str) -> None:
    sheet.write_text(sheet.read_text().replace(good, bad, 1))
    result = dcfchk(sheet, 5)
    assert result.returncode == 1 and complaint in result.stderr


def test_dcf_tools_read_the_values_we_mean(sheet: Path) -> None:
    device = Device.from_dcf(str(sheet), {"NODEID": 5})
    defaults = DICTIONARY.defaults(5)
    numbers = [e for e in DICTIONARY.entries.values() if e.bits]
    assert {e.key for e in numbers} <= {i << 8 | s for i, subs in device.items() for s in subs}
    for entry in numbers:
        if entry.type is Type.REAL32:  # no form of its value suits every reader: SDO tells it
            continue
        assert device[entry.index][entry.sub].parse_value() == pytest.approx(defaults[entry.key]), entry
    assert {n: p.cob_id for n, p in device.tpdo.items() if p.cob_id < 0x8000_0000}.keys() == {1, 2}


def test_canopen_reads_the_values_we_mean(sheet: Path) -> None:
    read = canopen.import_od(str(sheet), 5)
    defaults = DICTIONARY.defaults(5)
    for entry in DICTIONARY.entries.values():
        item = read[entry.index]
        variable = item if DICTIONARY.objects[entry.index].code is Code.VAR else item[entry.sub]
        assert (variable.name, variable.data_type, variable.access_type) == (entry.name, entry.type, entry.access)
        assert variable.pdo_mappable == entry.mappable
        if entry.type not in {Type.REAL32, Type.DOMAIN}:  # these carry no value
            assert variable.default == defaults[entry.key], entry
            assert (variable.min, variable.max) == (entry.low, entry.high), entry


def test_one_sheet_serves_every_node() -> None:
    read = [canopen.import_od(_named(eds(DICTIONARY)), node) for node in (1, 99)]
    assert [od[0x1800][1].default for od in read] == [0x4000_0181, 0x4000_01E3]


def _named(text: str) -> io.StringIO:
    file = io.StringIO(text)
    file.name = "drive.eds"
    return file
