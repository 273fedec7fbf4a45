"""A station and gateways in processes of their own, with NATS and PostgreSQL: what clients see."""

import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest
from sqlalchemy import select
from sqlalchemy.engine import make_url

from hardware.recording.reader import RecordingReader
from service.database.engine import Database
from service.database.models import CalibrationRow
from tests.nats_server import NatsServer
from tests.service.application.stations import GatewayServer, Station, wait_until
from tests.service.conftest import postgres_copy

pytestmark = [pytest.mark.slow, pytest.mark.postgres]

ROOT: Final = Path(__file__).parents[3]
MARKERS_MM: Final = ((0.0, 0.0, 0.0), (80.0, 0.0, 0.0), (0.0, 60.0, 0.0), (20.0, 15.0, 40.0))
CENTRE_MM: Final = (0.0, 0.0, 1500.0)
SOURCE: Final[dict[str, Any]] = {
    "kind": "simulated",
    "settings": {
        "scene": {
            "kind": "still-points",
            "points_mm": [
                [a + b for a, b in zip(one, CENTRE_MM, strict=True)] for one in MARKERS_MM
            ],
        },
        "frame_rate_hz": 200,
    },
}


class Hall:
    """A broker, a database, a station and two gateways."""

    def __init__(self, folder: Path, database: str) -> None:
        self.folder = folder
        self.database = database
        # As it is delivered: what each may publish and read is what it needs.
        configuration = (ROOT / "deploy" / "nats.conf").read_text(encoding="utf-8")
        passwords = {f"{name}_PASSWORD": "secret" for name in ("GATEWAY", "DISPLAY")}
        passwords |= {f"BAR_{number}_PASSWORD": "secret" for number in (1, 2)}
        self.broker = NatsServer(
            folder, configuration.replace("port: 4222", ""), environment=passwords
        )
        self.broker.start()
        url = self.broker.url_of("bar-1", "secret")
        # It writes nothing there.
        reading = make_url(database).update_query_dict(
            {"options": "-cdefault_transaction_read_only=on"}
        )
        self.station = Station("bar-1", folder, url, reading.render_as_string(hide_password=False))
        url = self.broker.url_of("gateway", "secret")
        self.gateway = GatewayServer("gateway-1", folder, url, database)
        self.other = GatewayServer("gateway-2", folder, url, database)

    def close(self) -> None:
        for one in (self.gateway, self.other, self.station):
            one.kill(signal.SIGTERM)
        self.broker.kill()

    def settled(self) -> bool:
        """Whether the device runs as both gateways see it, and its beam may go on."""
        return all(
            one.running("sim") and not hold(one)["held"] and standing(one) == "running"
            for one in (self.gateway, self.other)
        )


def standing(gateway: GatewayServer) -> str | None:
    found = gateway.station("bar-1")
    return None if found is None else str(found["state"])


def hold(gateway: GatewayServer) -> dict[str, Any]:
    found: dict[str, Any] = gateway.get("/beam-holds/patient/state")
    return found


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory, new_postgres: str | None) -> Iterator[Hall]:
    """Both bars of a hall: its device runs, with a tool and a beam hold."""
    if new_postgres is None:
        pytest.skip("databases may not be made in the PostgreSQL server for tests")
    copies = postgres_copy(new_postgres)
    made = Hall(tmp_path_factory.mktemp("hall"), next(copies))
    try:
        made.station.start()
        # One after the other: the first has the server's own devices, and can give one away.
        for one in (made.gateway, made.other):
            one.begin()
            wait_until(one.answers, "the gateway's start")
        wait_until(lambda: standing(made.gateway) == "running", "the station")
        change = {"station": "bar-1", "source": SOURCE, "autostart": True}
        for method, path, body in (
            ("PATCH", "/devices/sim", change),
            ("POST", "/devices/sim/start", None),
            (
                "POST",
                "/tools",
                {
                    "id": "head", "device_id": "sim", "title": "Head", "markers_mm": MARKERS_MM,
                    "strobe_markers": [0, 1, 2, 3],
                },
            ),
            (
                "POST",
                "/beam-holds",
                {
                    "id": "patient", "device_id": "sim", "title": "Patient",
                    "watch": {"kind": "strobed-markers", "markers": [0, 1, 2, 3]},
                    "limits": {"shift_mm": 2.0},
                    "rules": {"max_gap_s": 0.5, "settle_s": 0.1},
                    "reference": {"positions_mm": SOURCE["settings"]["scene"]["points_mm"]},
                },
            ),
        ):  # fmt: skip
            answer = made.gateway.request(method, path, body)
            assert answer.status_code < 300, answer.text
        wait_until(made.settled, "the hall's start")
        yield made
    except BaseException:
        for one in (made.station, made.gateway, made.other):
            print(one.text[-4000:])
        raise
    finally:
        made.close()
        next(copies, None)


@pytest.fixture(autouse=True)
def whole(hall: Hall) -> None:
    """Let each test begin with all that there is."""
    wait_until(hall.settled, "that all runs again")


def test_frames_of_a_station_come_to_all_gateways_in_order_and_whole(hall: Hall) -> None:
    for gateway in (hall.gateway, hall.other):
        with gateway.stream("sim", "points,tools,holds") as messages:
            first = messages.until(lambda one: one["type"] == "frame")[-1]["sequence"]
            taken = messages.until(
                lambda one, last=first + 200: one["type"] == "frame" and one["sequence"] >= last
            )
        frames = [one for one in taken if one["type"] == "frame"]
        numbers = [one["sequence"] for one in frames]
        assert numbers == list(range(first + 1, first + 1 + len(numbers)))
        assert all(one["points"] for one in frames)

        def good(one: dict[str, Any]) -> bool:
            found = one["type"] == "frame" and one["tools"][0]["status"] == "OK"
            return found and not one["holds"][0]["held"]

        with gateway.stream("sim", "tools,holds") as messages:
            messages.until(good)


def test_start_and_stop_have_happened_when_they_are_answered(hall: Hall) -> None:
    assert hall.gateway.request("POST", "/devices/sim/stop").json()["state"] == "stopped"
    assert hall.gateway.state("sim")["state"] == "stopped"
    assert hold(hall.gateway)["held"]
    wait_until(lambda: hall.other.state("sim")["state"] == "stopped", "the other's word of it")
    assert hall.other.request("POST", "/devices/sim/start").json()["state"] == "running"
    assert hall.other.state("sim")["state"] == "running"


def test_activation_and_tools_are_the_stations_with_the_answer(hall: Hall) -> None:
    database = Database(hall.database)
    with database.write() as session:
        row = session.scalars(select(CalibrationRow).limit(1)).one()
        members = {one.name: getattr(row, one.name) for one in CalibrationRow.__table__.columns}
        before = row.id
        session.add(CalibrationRow(**members | {"id": "copy"}))
    database.close()
    for calibration, gateway in (("copy", hall.gateway), (before, hall.other)):
        answer = gateway.request("POST", f"/calibrations/{calibration}/activate")
        assert answer.status_code == 200, answer.text
        assert gateway.state("sim")["calibration_id"] == calibration
    answer = hall.gateway.request("DELETE", "/tools/head")
    assert answer.status_code == 204, answer.text
    with hall.gateway.stream("sim", "tools") as messages:
        assert messages.until(lambda one: one["type"] == "frame")[-1]["tools"] == []
    body = {
        "id": "head", "device_id": "sim", "title": "Head", "markers_mm": MARKERS_MM,
        "strobe_markers": [0, 1, 2, 3],
    }  # fmt: skip
    assert hall.gateway.request("POST", "/tools", body).status_code == 201
    wait_until(
        lambda: hall.other.get("/tools/head/pose")["status"] == "OK", "the pose at the other"
    )


def test_recording_of_a_station_has_pixels_and_calibration(hall: Hall) -> None:
    started = hall.gateway.request("POST", "/devices/sim/recordings", {})
    assert started.status_code == 201, started.text
    name = started.json()["id"]
    wait_until(
        lambda: hall.gateway.get(f"/recordings/{name}")["frames_written"] > 100, "the recording"
    )
    stopped = hall.gateway.request("POST", f"/recordings/{name}/stop").json()
    assert stopped["frames_dropped_writer"] == 0
    with RecordingReader(hall.folder / "gateway-1" / "recordings" / name) as recording:
        frames = list(recording.frames())
        assert recording.active_calibration(0)[0]
    numbers = [frame.sequence for frame in frames]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert all(frame.lines.shape == (4, 2048) and frame.lines.any() for frame in frames)


def test_scans_of_a_station_are_shown_with_what_finds_their_peaks(hall: Hall) -> None:
    found = hall.other.get("/devices/sim/scans")
    assert all(one["peaks"] for one in found["scans"])


def test_station_that_is_killed_is_told_and_comes_back_by_itself(hall: Hall) -> None:
    with hall.gateway.stream("sim", "holds") as messages:
        messages.until(lambda one: one["type"] == "frame")
        hall.station.kill()
        lost = messages.until(
            lambda one: one["type"] == "state" and one["state"] == "disconnected"
        )[-1]
        assert '"bar-1" is lost' in lost["reason"]
        now = hold(hall.gateway)
        assert now["held"]
        answer = hall.gateway.request("POST", "/devices/sim/start")
        assert answer.status_code == 503, answer.text
        assert '"bar-1" was not reached' in answer.json()["detail"]
        assert standing(hall.gateway) == "lost"
        hall.station.start()
        messages.until(lambda one: one["type"] == "state" and one["state"] == "running")
        messages.until(lambda one: one["type"] == "frame")


def test_what_is_stored_while_the_station_is_away_it_has_when_it_is_back(hall: Hall) -> None:
    hall.station.kill()
    wait_until(lambda: standing(hall.gateway) == "lost", "that it is missed")
    answer = hall.gateway.request("PATCH", "/beam-holds/patient", {"limits": {"shift_mm": 3.0}})
    assert answer.status_code == 503, answer.text
    assert "it is stored" in answer.json()["detail"]
    assert hall.other.get("/beam-holds/patient")["limits"]["shift_mm"] == 3.0
    hall.station.start()
    wait_until(hall.settled, "that it is back")


def test_broker_that_is_killed_holds_beams_at_their_deadline_and_stops_no_device(
    hall: Hall,
) -> None:
    before = hall.gateway.state("sim")["frames_processed"]
    hall.broker.kill()
    try:
        wait_until(lambda: hold(hall.gateway)["held"], "the hold")
        # At first it is only known that the deadline has passed; then why no word came.
        wait_until(lambda: "bus" in hold(hall.gateway)["reason"], "the reason")
        wait_until(lambda: standing(hall.other) == "lost", "that it is missed")
        assert "bus" in hall.other.station("bar-1")["reason"]
        answer = hall.gateway.request("POST", "/devices/sim/stop")
        assert answer.status_code == 503, answer.text
        time.sleep(1.0)
    finally:
        hall.broker.start()
    wait_until(hall.settled, "that it is back")
    # The same start: nothing was begun anew.
    assert hall.gateway.state("sim")["frames_processed"] > before + 200


def test_broker_that_hangs_is_as_good_as_cut(hall: Hall) -> None:
    hall.broker.freeze()
    try:
        wait_until(lambda: hold(hall.gateway)["held"], "the hold")
        wait_until(lambda: standing(hall.gateway) == "lost", "that it is missed")
    finally:
        hall.broker.thaw()
    wait_until(hall.settled, "that it is back")


def test_gateway_that_is_killed_is_missed_by_nobody_and_knows_all_when_it_is_back(
    hall: Hall,
) -> None:
    with hall.gateway.stream("sim") as messages:
        first = messages.until(lambda one: one["type"] == "frame")[-1]["sequence"]
        hall.other.kill()
        taken = messages.until(
            lambda one: one["type"] == "frame" and one["sequence"] >= first + 400
        )
        frames = [one["sequence"] for one in taken if one["type"] == "frame"]
        assert frames == list(range(first + 1, first + 1 + len(frames)))
        hall.other.start()
        wait_until(hall.settled, "that it is back")
        rest = messages.until(lambda one: one["type"] == "frame")
        assert not [one for one in rest if one["type"] == "state"]


def test_station_that_hangs_holds_its_beams(hall: Hall) -> None:
    hall.station.send(signal.SIGSTOP)
    try:
        wait_until(lambda: hold(hall.gateway)["held"], "the hold")
        wait_until(lambda: standing(hall.gateway) == "lost", "that it is missed")
    finally:
        hall.station.send(signal.SIGCONT)
    wait_until(hall.settled, "that it is back")


def test_metrics_tell_of_the_station(hall: Hall) -> None:
    import httpx

    text = httpx.get(f"{hall.gateway.url}/metrics").text
    assert 'lumiline_remote_station_up{station="bar-1"} 1.0' in text
    assert 'lumiline_remote_station_round_trip_seconds{station="bar-1"}' in text
