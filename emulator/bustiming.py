"""Ideal or true buses for a rig, and what goes wrong on them."""

from collections.abc import Iterable

from emulator.disturbance import is_disturbance, parse
from emulator.wire import Wire
from protocols.errors import ConfigError
from protocols.rig import Rig

IDEAL, TRUE = "ideal", "true"


def wires(rig: Rig, timing: str, faults: Iterable[str] = ()) -> dict[str, Wire]:
    """Wires of a rig's buses by name; none where all of them are ideal and nothing goes wrong.

    Args:
        timing: `ideal`: frames take no time; `true`: as long as they are at the bus's bit rate.
        faults: Texts; those that are not of the bus are passed over.

    Raises:
        ConfigError: Neither timing; as `disturbance.parse`.
    """
    if timing not in {IDEAL, TRUE}:
        raise ConfigError(f"--bus-timing {timing}: choose {IDEAL} or {TRUE}.")
    disturbances = [parse(text, rig) for text in faults if is_disturbance(text)]
    if timing == IDEAL and not disturbances:
        return {}
    return {
        bus.name: Wire(
            bus.bitrate if timing == TRUE else None, disturbances=[d for d in disturbances if d.bus == bus.name]
        )
        for bus in rig.bus
    }


def served(rig: Rig, timing: str, faults: Iterable[str] = ()) -> dict[str, Wire]:
    """As `wires`, for the buses that a hub of ours serves.

    Raises:
        ConfigError: Also when time or faults are asked for on a bus that somebody else carries.
    """
    made = wires(rig, timing, faults)
    foreign = [b for b in rig.bus if b.interface != "virtualcan"]
    if made and foreign:
        raise ConfigError(
            f"bus {foreign[0].name} is {foreign[0].interface}: its timing and faults are its own."
            " Give it the interface virtualcan, or leave out --bus-timing and the faults of buses."
        )
    return made
