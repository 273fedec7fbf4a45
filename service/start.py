"""Makes ready what the service needs before it serves: data directory, database, first content."""

from service.database.engine import Database
from service.database.migrate import migrate
from service.database.seed import seed
from service.settings import Settings


def prepare(settings: Settings, database: Database) -> tuple[str, ...]:
    """Make the data directory, bring the database up to date, fill a new one; may be repeated.

    Returns:
        The devices that the settings say to start, beside those that start by themselves.

    Raises:
        OSError: the data directory cannot be made.
        SQLAlchemyError: the database does not answer or cannot be used.
        CommandError: it is of a revision that is not known here.
        InvalidParameter: the device profile of the settings cannot be used.
    """
    settings.folders.recordings.mkdir(parents=True, exist_ok=True)
    migrate(database, fill=seed)
    if settings.device is None:
        return ()
    # Only here: profiles bring the whole of the optics with them.
    from service.devices.profile_device import add_profile_device
    from service.devices.profiles import take_in

    profile = take_in(settings.device, settings.folders.profiles)
    with database.write() as session:
        add_profile_device(session, profile)
    return (profile.name,)
