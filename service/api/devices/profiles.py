"""Device profiles that the service knows: the built-in ones and those in the data directory."""

import logging
import re
from hashlib import sha256
from importlib import resources
from pathlib import Path
from typing import Final

from compute.errors import InvalidParameter
from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.profile_loader import load_profile, parse_profile, profile_names
from service.api.devices.schema import PROFILE_PATTERN
from service.problems.errors import UnknownDeviceProfile

_log = logging.getLogger(__name__)

LONGEST_NAME: Final = 55
"""Of a profile that becomes a device: the id of its calibration ends in "-nominal"."""


def stored_profile_names(profiles_dir: Path) -> list[str]:
    """Return the names of the data directory's profiles, in alphabetical order."""
    return sorted(
        file.stem
        for file in profiles_dir.glob("*.toml")
        if re.fullmatch(PROFILE_PATTERN, file.stem) and file.stem not in profile_names()
    )


def profile_text(name: str, profiles_dir: Path) -> str:
    """Return the file of a profile.

    Raises:
        UnknownDeviceProfile: it is neither built in nor in the data directory.
        InvalidParameter: its file cannot be read.
    """
    if name in profile_names():
        file = resources.files("compute.optics.profiles") / "devices" / f"{name}.toml"
        return file.read_text("utf-8")
    own = stored_profile_names(profiles_dir)
    if name not in own:
        raise UnknownDeviceProfile(
            f'there is no device profile "{name}"; there are {", ".join([*profile_names(), *own])}',
            name=name,
        )
    try:
        return stored_profile_path(name, profiles_dir).read_text("utf-8")
    except (OSError, ValueError) as error:  # ValueError: not UTF-8
        reason = error.strerror if isinstance(error, OSError) else error
        raise InvalidParameter(
            f'profile "{name}" cannot be read: {reason}', profile_id=name
        ) from None


def profile_hash(name: str, profiles_dir: Path) -> str:
    """Return the SHA-256 of a profile's file; raises as ``profile_text``."""
    return sha256(profile_text(name, profiles_dir).encode()).hexdigest()


def find_profile(name: str, profiles_dir: Path) -> DeviceProfile:
    """Return a profile by its name.

    Raises:
        UnknownDeviceProfile: it is neither built in nor in the data directory.
        InvalidParameter: its file is not a profile, or has another name than the profile.
    """
    if name in profile_names():
        return load_profile(name)
    profile = parse_profile(profile_text(name, profiles_dir), origin=name)
    if profile.name != name:
        raise InvalidParameter(
            f'profile {name}: name is "{profile.name}"; it must be that of its file, "{name}"',
            name=profile.name,
        )
    return profile


def all_profiles(profiles_dir: Path) -> list[DeviceProfile]:
    """Return all profiles by name; a file that is not one is left out, with a line in the log."""
    found = [load_profile(name) for name in profile_names()]
    for name in stored_profile_names(profiles_dir):
        try:
            found.append(find_profile(name, profiles_dir))
        except InvalidParameter as error:
            _log.warning("%s", error.detail)
    return sorted(found, key=lambda profile: profile.name)


def stored_profile_path(name: str, profiles_dir: Path) -> Path:
    """Return where the data directory keeps a profile of one's own."""
    return profiles_dir / f"{name}.toml"


def resolve_profile(name_or_path: str, profiles_dir: Path) -> DeviceProfile:
    """Return a profile by its name, or by the path of a file that may become the service's own.

    Raises:
        InvalidParameter: there is no such profile; it is not one; its name cannot be a device's,
            is that of a built-in profile, or of another profile in the data directory.
    """
    if name_or_path in profile_names():
        return load_profile(name_or_path)
    if name_or_path in stored_profile_names(profiles_dir) and not Path(name_or_path).is_file():
        return _with_usable_name(find_profile(name_or_path, profiles_dir))
    profile = _with_usable_name(load_profile(name_or_path))
    if profile.name in profile_names():
        raise InvalidParameter(
            f'name is "{profile.name}", which is a built-in profile; give yours a name of its own',
            name=profile.name,
        )
    kept = stored_profile_path(profile.name, profiles_dir)
    if kept.is_file() and kept.read_bytes() != Path(name_or_path).read_bytes():
        raise InvalidParameter(
            f'name is "{profile.name}", and another profile of this name is in use from {kept}; '
            "give yours another name, or delete that one's device and file first",
            name=profile.name,
        )
    return profile


def check_not_overwritten(profile: DeviceProfile, device: str, profiles_dir: Path) -> None:
    """Make sure that a stored device's own profile is still the one that it was made from.

    Raises:
        InvalidParameter: the data directory does not have it any more.
    """
    kept = stored_profile_path(profile.name, profiles_dir)
    if profile.name not in profile_names() and not kept.is_file():
        raise InvalidParameter(
            f'device "{device}" was made from a profile that was in {kept} and is gone; put it '
            "back there, or delete the device first",
            name=profile.name,
        )


def keep(name_or_path: str, profile: DeviceProfile, profiles_dir: Path) -> None:
    """Copy the file of a given profile into the data directory, unless it is there or built in."""
    kept = stored_profile_path(profile.name, profiles_dir)
    if profile.name in profile_names() or kept.is_file():
        return
    _write(kept, Path(name_or_path).read_bytes())


def _write(kept: Path, content: bytes) -> None:
    """Write a profile's file, never half of one under its name."""
    kept.parent.mkdir(parents=True, exist_ok=True)
    part = kept.with_suffix(".part")
    part.write_bytes(content)
    part.replace(kept)


def posted_profile(text: str) -> DeviceProfile:
    """Return the profile of a text that a client sent; raises InvalidParameter."""
    return parse_profile(text, origin="toml")


def store_posted(text: str, profiles_dir: Path) -> DeviceProfile:
    """Keep a profile that a client sent in the data directory, under its name.

    Raises:
        InvalidParameter: it is not a profile, its name cannot be a device's, or is that of
            another profile.
    """
    profile = _with_usable_name(posted_profile(text))
    if profile.name in (*profile_names(), *stored_profile_names(profiles_dir)):
        raise InvalidParameter(
            f'name is "{profile.name}", and there is a profile of this name; give yours another',
            name=profile.name,
        )
    _write(stored_profile_path(profile.name, profiles_dir), text.encode())
    return profile


def _with_usable_name(profile: DeviceProfile) -> DeviceProfile:
    name = profile.name
    if re.fullmatch(PROFILE_PATTERN, name) is None or len(name) > LONGEST_NAME:
        raise InvalidParameter(
            f"name is {name!r}; the name of a profile that becomes a device has 1 to "
            f"{LONGEST_NAME} lower case letters, digits, hyphens and dots, and begins and ends "
            "with a letter or digit",
            name=name,
        )
    return profile
