"""Devices of stations: refused without a bus; a station makes itself what the database says."""

from dataclasses import replace
from typing import Any

import pytest

from compute.pose.settings import ToolTrackerSettings
from compute.tracking.blink_codes import BlinkCodes
from compute.tracking.blink_decoding import BlinkModel
from compute.tracking.settings import TrackerSettings
from service.api.beam_holds.monitor_config import tracking_config_of
from service.api.correction_tables.store import active_calibration
from service.api.devices.device_service import DeviceService, StoredContent
from service.api.devices.station_devices import StationDevices, digest
from service.api.radiometric_calibrations.store import active_radiometric
from service.database.engine import Database
from service.database.models import DeviceRow
from service.pipeline.tracking_config import TrackingConfig
from service.problems.errors import UnknownDevice
from service.settings import Settings
from tests.service.api.beam_holds.batches import hold
from tests.service.fake_pipeline import FakePipeline, TestClient
from tests.service.pipeline.test_tools_live import tools

SIMULATED = {"kind": "simulated", "settings": {}}


class Bench:
    """A station with the device ``sim``."""

    def __init__(self, settings: Settings, database: Database) -> None:
        self.database = database
        self.live = FakePipeline()
        with database.write() as session:
            session.get_one(DeviceRow, "sim").station = "bar-1"
        stored = StoredContent(active_calibration, active_radiometric, tracking_config_of)
        service = DeviceService(database, self.live, settings.folders, stored, own="bar-1")
        self.devices = StationDevices("bar-1", database, self.live, service)

    def calls(self) -> list[str]:
        """What the live side was asked for since."""
        names = [str(call[0]) for call in self.live.calls]
        self.live.calls.clear()
        return names

    def change(self, **members: Any) -> None:
        with self.database.write() as session:
            row = session.get_one(DeviceRow, "sim")
            for name, value in members.items():
                setattr(row, name, value)


@pytest.fixture
def bench(settings: Settings, database: Database) -> Bench:
    return Bench(settings, database)


def test_station_starts_the_devices_that_say_so_and_no_others(bench: Bench) -> None:
    bench.change(autostart=True)
    bench.devices.begin()
    assert "start" in bench.calls()
    bench.change(station="bar-2")
    with pytest.raises(UnknownDevice, match='not of the station "bar-1"'):
        bench.devices.start("sim")


def test_what_has_not_changed_is_not_touched(bench: Bench) -> None:
    bench.devices.reconcile()
    bench.calls()
    before = bench.devices.digests
    bench.devices.reconcile()
    assert bench.calls() == []
    assert bench.devices.digests == before


def test_what_another_has_changed_is_taken_over(bench: Bench) -> None:
    bench.devices.reconcile()
    bench.calls()
    before = bench.devices.digests["sim"]
    bench.change(tracking={"tracks": "always"})
    bench.devices.reconcile()
    assert bench.live.tracked["sim"].tracks
    assert bench.devices.digests["sim"] != before


def test_equal_configurations_have_one_digest_whenever_they_are_read() -> None:
    def config() -> TrackingConfig:
        blinking = (BlinkCodes(("10110100", "11001010"), 1, cyclic=False), BlinkModel())
        return TrackingConfig(
            True, tools("strobed"), TrackerSettings(), ToolTrackerSettings(), blinking, (hold(),)
        )

    assert digest(config()) == digest(config())
    assert digest(config()) != digest(replace(config(), holds=()))


def test_device_of_another_station_is_forgotten(bench: Bench) -> None:
    bench.devices.reconcile()
    bench.calls()
    bench.change(station="bar-2")
    bench.devices.reconcile()
    assert "forget" in bench.calls()
    assert bench.devices.digests == {}
    bench.devices.reconcile()
    assert bench.calls() == []


def test_station_without_a_bus_is_refused(sqlite_client: TestClient) -> None:
    body = {"id": "far", "title": "Far", "station": "bar-1", "source": SIMULATED}
    answer = sqlite_client.post("/api/v1/devices", json=body)
    assert (answer.status_code, answer.json()["type"]) == (422, "/problems/unknown-station")
    assert "bus_url" in answer.json()["detail"]
    answer = sqlite_client.patch("/api/v1/devices/sim", json={"station": "bar-1"})
    assert answer.status_code == 422
    assert sqlite_client.get("/api/v1/devices/sim").json()["station"] is None


def test_server_of_its_own_devices_has_no_other_stations(sqlite_client: TestClient) -> None:
    assert sqlite_client.get("/api/v1/stations").json()["items"] == []
