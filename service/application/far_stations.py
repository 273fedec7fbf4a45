"""What a server or a station needs of settings and database for the bus between machines."""

from typing import TYPE_CHECKING

from service.api.correction_tables.store import stored_calibration
from service.api.radiometric_calibrations.store import active_radiometric
from service.database.engine import Database
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.tracking_config import TrackingConfig
from service.settings import Settings
from service.station.network.connection import BusOptions
from service.station.network.network_pipeline import StoredIds, StoredReader

if TYPE_CHECKING:
    from service.api.devices.device_service import DeviceService


def bus_options(settings: Settings) -> BusOptions:
    """Return how the bus of these settings is reached."""
    return BusOptions(
        tuple(url.strip() for url in (settings.bus_url or "").split(",")),
        settings.bus_nkey_seed,
        settings.bus_credentials,
        settings.bus_token_file,
        settings.bus_ca,
    )


class StoredDevices:
    """Reads what the database has of devices of stations; the service comes later."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self.service: DeviceService | None = None

    @property
    def reader(self) -> StoredReader:
        """Return the readers that pipelines take."""
        return StoredReader(self._device, self._calibration)

    def _device(self, device_id: str) -> tuple[ActiveCalibration, TrackingConfig]:
        assert self.service is not None
        _, calibration, tracking = self.service.stored(device_id)
        return calibration, tracking

    def _calibration(self, ids: StoredIds) -> ActiveCalibration:
        calibration_id, table_id, radiometric_id = ids
        with self._database.read() as session:
            radiometric = (
                None if radiometric_id is None else active_radiometric(session, radiometric_id)
            )
            return stored_calibration(session, calibration_id, table_id, radiometric)
