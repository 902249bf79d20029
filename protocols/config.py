"""TOML files to typed values: defaults < file < overrides; unknown keys refused with their path."""

import tomllib
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import tomli_w

from protocols.errors import ConfigError

T = TypeVar("T", bound=msgspec.Struct)

SHIPPED = "library"  # package folder with the robots, rigs and motions that come with armrig


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of every configuration table: immutable, unknown keys are errors."""


def parse(text: str, kind: type[T], source: str) -> T:
    """Typed value of TOML text.

    Args:
        source: Name of the file for messages.

    Raises:
        ConfigError: Not TOML, an unknown or missing key, a wrong type or a value out of range; names the path.
    """
    try:
        return msgspec.convert(tomllib.loads(text), kind)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source}: not valid TOML: {error}.") from error
    except msgspec.ValidationError as error:
        raise ConfigError(f"{source}: {_sentence(str(error))}") from error
    except ValueError as error:  # raised by __post_init__ checks outside msgspec's own wrapping
        raise ConfigError(f"{source}: {error}") from error


def _sentence(message: str) -> str:
    """msgspec's 'Object contains unknown field `x` - at `$.joint[0]`' with the path in TOML's words."""
    what, _, path = message.partition(" - at `$")
    what = what.replace("Object contains unknown field", "unknown key").replace(
        "Object missing required field", "missing key"
    )
    where = path.rstrip("`").lstrip(".")
    return f"{what}, at {where}." if where else f"{what}."


def locate(name: str, suffix: str = ".toml", base: Path | None = None) -> Path:
    """File of a name: a path, a path relative to `base` (the file that names it), or a shipped file's stem.

    Raises:
        ConfigError: No such file; lists what is shipped.
    """
    for candidate in (Path(name), (base or Path()) / name):
        if candidate.is_file():
            return candidate
    shipped = Path(str(resources.files("protocols") / SHIPPED))
    stem = name.removesuffix(suffix)
    if (shipped / f"{stem}{suffix}").is_file():
        return shipped / f"{stem}{suffix}"
    known = ", ".join(sorted(p.name.removesuffix(suffix) for p in shipped.glob(f"*{suffix}")))
    raise ConfigError(f"{name}: no such file, and not one of the shipped {known}.")


def read(path: Path, kind: type[T]) -> T:
    """Typed value of a TOML file.

    Raises:
        ConfigError: Unreadable, or as `parse`.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}.") from error
    return parse(text, kind, str(path))


def to_toml(value: msgspec.Struct) -> str:
    """TOML text of a configuration value; `parse` of it gives the value back."""
    return tomli_w.dumps(_without_none(msgspec.to_builtins(value)))


def _without_none(value: Any) -> Any:
    """TOML has no null: an absent key stands for None."""
    if isinstance(value, dict):
        return {k: _without_none(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [_without_none(v) for v in value]
    return value
