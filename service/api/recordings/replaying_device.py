"""Which running device replays a recording."""

from pathlib import PurePosixPath

from sqlalchemy import select

from service.database.engine import Database
from service.database.models import DeviceRow
from service.pipeline.pipeline_manager import PipelineManager

_GONE = ("stopped", "ended", "failed")


def replaying_device(database: Database, live: PipelineManager, name: str) -> str | None:
    """Return the id of a device that replays the recording now, None without one."""
    with database.read() as session:
        sources = session.execute(select(DeviceRow.id, DeviceRow.source)).all()
    for device_id, source in sources:
        if source.get("kind") != "replay":
            continue
        same = PurePosixPath(str(source.get("recording"))) == PurePosixPath(name)
        if same and live.status(device_id).state not in _GONE:
            return str(device_id)
    return None
