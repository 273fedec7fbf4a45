"""Prepares data directory, database and first content before serving."""

import logging
from pathlib import Path

from service.application.initial_content import seed
from service.database.engine import Database
from service.database.migration import migrate
from service.settings import Settings

_log = logging.getLogger(__name__)


def prepare(settings: Settings, database: Database) -> tuple[str, ...]:
    """Make the data directory, bring the database up to date, fill a new one; may be repeated.

    Returns:
        The devices that the settings say to start, beside those that start by themselves.

    Raises:
        OSError: the data directory cannot be made or written to.
        SQLAlchemyError, NotReady: the database does not answer or cannot be used.
        CommandError: it is of a revision that is not known here.
        LumilineError: the device profile of the settings cannot be used.
    """
    settings.folders.recordings.mkdir(parents=True, exist_ok=True)
    migrate(database, fill=seed)
    if settings.profile is None:
        return ()
    return (_stored_device(settings.profile, settings.folders.profiles, database),)


def trace_optics(settings: Settings, database: Database, named: tuple[str, ...]) -> None:
    """Trace the optics of these devices' profiles: beside running devices it takes much longer.

    Raises:
        LumilineError: a profile cannot be used, or the database not be read.
    """
    if not named:
        return
    from compute.optics.profiles.profile_optics import profile_optics
    from service.api.devices.profiles import find_profile
    from service.api.devices.schema import ProfileSource
    from service.api.devices.store import get_device, source_of

    for identity in named:
        with database.read() as session:
            source = source_of(get_device(session, identity))
        assert isinstance(source, ProfileSource)
        _log.info("device %s: tracing its optics, some seconds", identity)
        # Its tables are kept, for the driver to find.
        profile = find_profile(source.profile_id, settings.folders.profiles)
        profile_optics(profile, source.settings.optics)


def _stored_device(name_or_path: str, folder: Path, database: Database) -> str:
    """Store the device of a profile unless it is there; return its id."""
    # Only here: profiles bring the whole of the optics with them.
    from service.api.devices import profiles
    from service.application import profile_device as devices

    profile = profiles.resolve_profile(name_or_path, folder)
    identity = devices.device_id(profile.name)
    with database.read() as session:
        stored = devices.is_stored(session, profile)
    if stored:
        profiles.check_not_overwritten(profile, identity, folder)
        return identity
    _log.info("device %s: fitting its calibration to its optics, some seconds", identity)
    device = devices.profile_device(profile)
    profiles.keep(name_or_path, profile, folder)
    with database.write() as session:
        if not devices.is_stored(session, profile):  # another server may have been quicker
            file_hash = profiles.profile_hash(profile.name, folder)
            devices.store_profile_device(session, device, file_hash)
    return identity
