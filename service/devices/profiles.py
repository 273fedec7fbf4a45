"""Device profiles as sources: the built-in ones and those in the data directory."""

import shutil
from pathlib import Path

from compute.errors import InvalidParameter
from compute.optics.profiles.loader import load_profile, profile_names
from compute.optics.profiles.profile import DeviceProfile
from service.errors import UnknownDeviceProfile


def source_profile(name: str, profiles_dir: Path) -> DeviceProfile:
    """Return the profile that a device's source names.

    Raises:
        UnknownDeviceProfile: it is neither built in nor in the data directory.
        InvalidParameter: its file is not a profile.
    """
    if name in profile_names():
        return load_profile(name)
    path = profiles_dir / f"{name}.toml"
    if not path.is_file():
        own = sorted(file.stem for file in profiles_dir.glob("*.toml"))
        raise UnknownDeviceProfile(
            f'there is no device profile "{name}"; there are {", ".join([*profile_names(), *own])}',
            name=name,
        )
    return load_profile(path)


def take_in(name_or_path: str, profiles_dir: Path) -> DeviceProfile:
    """Return a built-in profile by name, or take the file of one's own into the data directory.

    Raises:
        InvalidParameter: there is no such profile, it is not one, it has the name of a built-in
            one, or another of its name was taken in before.
    """
    profile = load_profile(name_or_path)
    if name_or_path in profile_names():
        return profile
    if profile.name in profile_names():
        raise InvalidParameter(
            f'name is "{profile.name}", which is a built-in profile; give yours a name of its own',
            name=profile.name,
        )
    kept = profiles_dir / f"{profile.name}.toml"
    given = Path(name_or_path).read_bytes()
    if kept.is_file() and kept.read_bytes() != given:
        raise InvalidParameter(
            f'another profile named "{profile.name}" is in use from {kept}; give yours another '
            "name, or remove that file if its device is not needed any more",
            name=profile.name,
        )
    profiles_dir.mkdir(parents=True, exist_ok=True)
    if not kept.is_file():
        shutil.copyfile(name_or_path, kept)
    return profile
