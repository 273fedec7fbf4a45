"""Which sources a nominal calibration fits: it is right for what it was computed from alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from compute.errors import LumilineError
from service.api.devices.profiles import profile_hash
from service.api.devices.schema import ProfileSource, SimulatedSource, Source


def same_simulation(one: Source, other: Source) -> bool:
    """Whether two sources simulate the same optics; their scene and rate may differ."""
    if isinstance(one, ProfileSource) and isinstance(other, ProfileSource):
        return one.profile_id == other.profile_id
    return isinstance(one, SimulatedSource) and isinstance(other, SimulatedSource)


def nominal_mismatch(
    content: Mapping[str, Any] | None, source: Source, profiles_dir: Path
) -> str | None:
    """Return why a calibration may not be used with a source, and what would be right.

    None: it may, as any that is not nominal.

    Args:
        content: the calibration's content as it is stored.
        source: the device's source.
        profiles_dir: the data directory's profiles.
    """
    if content is None or content.get("provenance") != "nominal":
        return None
    profile = content.get("profile")
    if profile is None:
        # The simulator's, which other programs simulate as well: a serial device, a recording.
        return None
    name = profile["profile_id"]
    design = f'it is computed from the profile "{name}"'
    if not isinstance(source, ProfileSource) or source.profile_id != name:
        return f"{design}, and the device's source is {_shown(source)}; {_right(source)}"
    try:
        now = profile_hash(name, profiles_dir)
    except LumilineError as error:
        return f"{design}, which cannot be read: {error.detail}"
    if now != profile["content_hash"]:
        return f"{design} as its file was before it was changed; make a nominal calibration anew"
    return None


def _shown(source: Source) -> str:
    if isinstance(source, ProfileSource):
        return f'the profile "{source.profile_id}"'
    return source.kind


def _right(source: Source) -> str:
    if isinstance(source, ProfileSource):
        return "make a nominal calibration of this profile, or calibrate from points"
    return "calibrate the device from points that were measured"
