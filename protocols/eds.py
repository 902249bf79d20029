"""Electronic data sheet of a dictionary (CiA 306-1): what configuration tools and masters read."""

from collections.abc import Iterable, Iterator

from protocols.dictionary import PDOS, PRODUCT, REVISION, VENDOR
from protocols.objects import Code, Dictionary, Entry, Object, Type

_MANDATORY = (0x1000, 0x1001, 0x1018)
_BIT_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)  # kbit/s


# A domain has no value. A REAL32's is left to SDO: CiA 306-1 writes its bits, which gocanopen refuses the whole sheet
# for, and canopen reads decimals.
_WITHOUT_VALUES = (Type.DOMAIN, Type.REAL32)


def eds(dictionary: Dictionary, file_name: str = "drive.eds") -> str:
    """Text of the data sheet. Node-ids stay the symbol `$NODEID`, so one text serves every drive of a kind."""
    indices = sorted(dictionary.objects)
    manufacturer = [i for i in indices if 0x2000 <= i < 0x6000]
    optional = [i for i in indices if i not in _MANDATORY and i not in manufacturer]
    parts: list[list[str]] = [
        _section(
            "FileInfo",
            FileName=file_name,
            FileVersion="1",
            FileRevision="1",
            EDSVersion="4.0",
            Description="CiA 402 servo drive of an emulated robot axis",
            CreatedBy="armrig",
        ),
        _section(
            "DeviceInfo",
            VendorName="armrig",
            VendorNumber=f"0x{VENDOR:08X}",
            ProductName="armrig servo drive",
            ProductNumber=f"0x{PRODUCT:08X}",
            RevisionNumber=f"0x{REVISION:08X}",
            **{f"BaudRate_{rate}": "1" for rate in _BIT_RATES},
            SimpleBootUpMaster="0",
            SimpleBootUpSlave="1",
            Granularity="8",
            DynamicChannelsSupported="0",
            GroupMessaging="0",
            NrOfRXPDO=str(PDOS),
            NrOfTXPDO=str(PDOS),
            LSS_Supported="1",
        ),
        _section("DummyUsage", **{f"Dummy{i:04d}": "0" for i in range(1, 8)}),
        _list("MandatoryObjects", _MANDATORY),
        _list("OptionalObjects", optional),
        _list("ManufacturerObjects", manufacturer),
    ]
    for index in indices:
        parts.extend(_object(dictionary.objects[index]))
    return "\n\n".join("\n".join(lines) for lines in parts) + "\n"


def _section(title: str, **keys: str) -> list[str]:
    return [f"[{title}]", *(f"{k}={v}" for k, v in keys.items())]


def _list(title: str, indices: Iterable[int]) -> list[str]:
    numbered = {str(n): f"0x{index:04X}" for n, index in enumerate(indices, 1)}
    return _section(title, SupportedObjects=str(len(numbered)), **numbered)


def _object(item: Object) -> Iterator[list[str]]:
    if item.code is Code.VAR:
        yield _section(f"{item.index:04X}", ObjectType="0x7", **_entry(item.entries[0]))
        return
    yield _section(
        f"{item.index:04X}",
        ParameterName=item.name,
        ObjectType=f"0x{item.code:X}",
        SubNumber=str(len(item.entries)),
    )
    for entry in item.entries:
        yield _section(f"{item.index:04X}sub{entry.sub:X}", ObjectType="0x7", **_entry(entry))


def _entry(entry: Entry) -> dict[str, str]:
    keys = {
        "ParameterName": entry.name,
        "DataType": f"0x{entry.type:04X}",
        "AccessType": entry.access,
    }
    valued = entry.type not in _WITHOUT_VALUES
    if valued:
        keys["DefaultValue"] = ("$NODEID+" if entry.node_relative else "") + _value(entry, entry.default)
    keys["PDOMapping"] = str(int(entry.mappable))
    if valued and entry.low is not None:
        keys["LowLimit"] = _value(entry, entry.low)
    if valued and entry.high is not None:
        keys["HighLimit"] = _value(entry, entry.high)
    return keys


def _value(entry: Entry, value: int | float | str) -> str:
    if isinstance(value, str):
        return value
    return f"0x{value:X}" if value >= 0 and entry.name.startswith("COB-ID") else str(int(value))
