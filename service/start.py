"""Makes ready what the service needs before it serves: data directory, database, first content."""

from service.database.engine import Database
from service.database.migrate import migrate
from service.database.seed import seed
from service.settings import Settings


def prepare(settings: Settings, database: Database) -> None:
    """Make the data directory, bring the database up to date, fill a new one; may be repeated.

    Raises:
        OSError: the data directory cannot be made.
        SQLAlchemyError: the database does not answer or cannot be used.
        CommandError: it is of a revision that is not known here.
    """
    settings.recordings_dir.mkdir(parents=True, exist_ok=True)
    migrate(database, fill=seed)
