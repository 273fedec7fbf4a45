"""Loading of profiles: built-in ones by name, others by path."""

import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Final

from compute.damaged_file import refusing_damage
from compute.errors import InvalidParameter
from compute.optics.profiles.device_profile import DeviceProfile
from compute.parameter_checks import require

_STEP = re.compile(r"([^.\[\]]+)|\[(\d{1,9})\]")

_MAX_DOTS: Final = 32
"""Of a line, but for those of numbers: for a dotted key tomllib needs a time that grows with the
square of its parts, 10 s for 64 KiB."""
_DECIMAL = re.compile(r"\d\.\d")


@cache
def profile_names() -> tuple[str, ...]:
    """Return the names of the built-in profiles, in alphabetical order."""
    files = (resources.files("compute.optics.profiles") / "devices").iterdir()
    return tuple(sorted(file.name[:-5] for file in files if file.name.endswith(".toml")))


def load_profile(name_or_path: str | Path) -> DeviceProfile:
    """Return a built-in profile by name, or a profile of a file by path.

    A text that is the name of a built-in profile means that one; "./name" is a file.

    Raises:
        InvalidParameter: there is no such profile or file, or it is not a profile; see
            ``parse_profile``.
    """
    if str(name_or_path) in profile_names():
        name = str(name_or_path)
        file = resources.files("compute.optics.profiles") / "devices" / f"{name}.toml"
        return parse_profile(file.read_text("utf-8"), origin=name)
    path = Path(name_or_path)
    try:
        text = path.read_text("utf-8")
    except (OSError, ValueError) as error:  # ValueError: not UTF-8, or a NUL in the path
        reason = error.strerror if isinstance(error, OSError) else error
        raise InvalidParameter(
            f'profile "{name_or_path}" cannot be read ({reason}); give the path of a profile, or '
            f"one of {', '.join(profile_names())}",
            profile=str(name_or_path),
        ) from None
    return parse_profile(text, origin=str(path))


def parse_profile(text: str, origin: str) -> DeviceProfile:
    """Return the profile that a TOML text describes.

    Args:
        text: the profile.
        origin: what errors call it: a name or a path.

    Raises:
        InvalidParameter: it is not TOML, or a field is missing, unknown, without its unit, of
            another kind or out of range. The message names every such field by its dotted path
            (``optics.main.elements[1].z``, counted from 0); ``context`` has the first as
            ``field`` and all as ``problems``.
    """
    # Here, so that nobody pays for pint who loads no profile.
    from compute.optics.profiles.deserialisation import Problem, build_profile

    with refusing_damage(
        lambda reason: InvalidParameter(f"profile {origin} is not TOML: {reason}", origin=origin)
    ):
        document = _parse_toml(text)
    profile, problems = build_profile(document)
    assumed = document.get("assumed")
    if isinstance(assumed, Mapping):
        problems += [
            Problem(f'assumed."{path}"', "the profile has no such field")
            for path in assumed
            if not _exists(document, path)
        ]
    if profile is None or problems:
        raise InvalidParameter(
            f"profile {origin}: " + "; ".join(map(str, problems)),
            origin=origin,
            field=problems[0].path,
            problems=[str(problem) for problem in problems],
        )
    return profile


def with_error_sources(profile: DeviceProfile, assignments: Iterable[str]) -> DeviceProfile:
    """Return a profile with other error sources, written as ``temperature_change=5 K``.

    They count as given, not as assumed.

    Args:
        profile: the device.
        assignments: names of fields of ``error_sources`` and their values, as in a profile's file.

    Raises:
        InvalidParameter: no such field, or a value that is none of its kind or out of range.
    """
    from compute.optics.profiles.deserialisation import build_error_sources

    table: dict[str, object] = {}
    for assignment in assignments:
        name, equals, text = (part.strip() for part in assignment.partition("="))
        require(bool(equals), 'be written as "speed=200 mm/s"', error_source=assignment)
        try:
            table[name] = _parse_toml(f"value = {text}")["value"]
        except ValueError:  # a quantity or a word without quotation marks
            table[name] = text
    sources, problems = build_error_sources(table)
    if sources is None:
        raise InvalidParameter(
            "; ".join(map(str, problems)), problems=[str(problem) for problem in problems]
        )
    set_sources = {name: value for name, value in vars(sources).items() if value is not None}
    paths = {f"error_sources.{name}" for name in table}
    return replace(
        profile,
        error_sources=replace(profile.error_sources, **set_sources),
        assumed={path: reason for path, reason in profile.assumed.items() if path not in paths},
    )


def _parse_toml(text: str) -> dict[str, Any]:
    """Return what tomllib makes of a text, unless that would take long.

    Raises:
        TOMLDecodeError: it is not TOML.
        ValueError: it is nested too deeply, has an integer of too many digits, or a line of too
            many dots.
    """
    for number, line in enumerate(text.split("\n"), 1):
        if line.count(".") > _MAX_DOTS and _DECIMAL.sub("", line).count(".") > _MAX_DOTS:
            raise ValueError(
                f"there are more than {_MAX_DOTS} dots, but for those of numbers (at line {number})"
            )
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError:
        raise ValueError("lists or tables are nested too deeply") from None
    except ValueError:
        raise ValueError("an integer has too many digits") from None


def _exists(document: object, path: str) -> bool:
    """Return whether a document has a value at a dotted path."""
    steps = _STEP.findall(path)
    if "".join(f".{key}" if key else f"[{number}]" for key, number in steps).lstrip(".") != path:
        return False
    here = document
    for key, number in steps:
        if key and isinstance(here, Mapping) and key in here:
            here = here[key]
        elif number and isinstance(here, list) and int(number) < len(here):
            here = here[int(number)]
        else:
            return False
    return True
