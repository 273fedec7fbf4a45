"""The answerer as a part of the service."""

import socket
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from compute.pose.rigid_body import RigidBody
from service.application.app import create_app
from service.pipeline.tracking_config import TrackingConfig
from service.settings import Settings
from tests.service.fake_pipeline import TestClient
from tests.service.protocols.ndi.fake_poses import entry, pose


def ask(connection: socket.socket, command: str) -> str:
    connection.sendall(command.encode() + b"\r")
    reply = b""
    while not reply.endswith(b"\r"):
        reply += connection.recv(4096)
    return reply[:-5].decode()


@pytest.mark.slow
def test_it_runs_where_settings_say_so(tmp_path: Path):
    settings = Settings(data_dir=tmp_path, compute_device="cpu", ndi_port=0, ndi_model="Model")
    app = create_app(settings)
    with TestClient(app) as client:
        live = app.state.live
        with socket.create_connection(app.state.ndi.address, timeout=60.0) as connection:
            assert "Freeze Tag: Model " in ask(connection, "VER 0")
            body = RigidBody("probe", np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0], [0, 70.0, 0.0]]))
            live.set_tracking_config("bar", TrackingConfig(tools=(body,)))
            given = pose("probe")
            live.poses.put(entry(given))
            assert ask(connection, "INIT") == "OKAY"
            assert ask(connection, "PHSR 02") == "0101001"
            assert ask(connection, "PINIT 01") == ask(connection, "PENA 01D") == "OKAY"
            assert ask(connection, "TSTART") == "OKAY"
            told = ask(connection, "TX 0009")
            while "MISSING" in told:
                # It took longer than poses are good for: the machine is busy.
                live.poses.put(entry(given))
                told = ask(connection, "TX 0009")
            place = told.index("000000310000000703") + 19
            assert given.translation_mm is not None
            assert int(told[place : place + 7]) / 100 == pytest.approx(
                given.translation_mm[0], abs=0.0051
            )
            text = client.get("/metrics").text
            assert "lumiline_ndi_clients 1.0" in text
            assert "lumiline_ndi_commands_refused_total 0.0" in text
        address = app.state.ndi.address
    with pytest.raises(OSError):
        socket.create_connection(address, timeout=1.0)


@pytest.mark.slow
def test_tools_of_a_device_that_never_ran(tmp_path: Path):
    app = create_app(Settings(data_dir=tmp_path, compute_device="cpu", ndi_port=0))
    with TestClient(app) as client:
        assert client.post("/api/v1/devices/sim/stop").status_code == 200
        tool = {
            "id": "probe", "device_id": "sim", "title": "Probe",
            "markers_mm": [[0, 0, 0], [50, 0, 0], [0, 70, 0], [20, 10, 30]],
        }  # fmt: skip
        made = client.post("/api/v1/tools", json=tool)
        assert made.status_code == 201, made.text
    with TestClient(create_app(app.state.settings)) as client:
        assert client.post("/api/v1/devices/sim/stop").status_code == 200
        with socket.create_connection(client.app.state.ndi.address, timeout=60.0) as connection:
            assert ask(connection, "INIT") == "OKAY"
            assert ask(connection, "PHSR 02") == "0101001"
            assert ask(connection, "PHINF 010004") == "probe".ljust(20)
            # Its limit is known, too: the pose's deviation is 0.37 mm at the tip, the origin.
            live = client.app.state.live
            for limit_mm, given in ((0.3, False), (0.5, True)):
                change = {"limits": {"tip_sd_mm": limit_mm}}
                assert client.patch("/api/v1/tools/probe", json=change).status_code == 200
                until_given(connection, live, given)


def until_given(connection: socket.socket, live: Any, given: bool) -> None:
    """Wait until a changed limit is known."""
    at = np.zeros(3)
    end = time.monotonic() + 240.0
    for command in ("INIT", "PHSR 02", "PINIT 01", "PENA 01D", "TSTART"):
        ask(connection, command)
    while time.monotonic() < end:
        live.poses.put(entry(pose("probe", translation_mm=at, tip_mm=at), device="sim"))
        told = ask(connection, "TX 0003")
        # Missing with the information that it does not fit well: not because it has got old.
        if ("MISSING" not in told) if given else (told[-27:-25] == "01"):
            return
    pytest.fail(told)


@pytest.mark.slow
def test_it_does_not_unless_they_do(tmp_path: Path):
    app = create_app(Settings(data_dir=tmp_path, compute_device="cpu"))
    with TestClient(app):
        assert not hasattr(app.state, "ndi")


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"ndi_port": 70_000}, "ndi_port"),
        ({"ndi_port": 8765, "ndi_host": "0.0.0.0"}, "ndi_allow"),
        ({"ndi_allow": ("everybody",)}, "ndi_allow"),
        ({"ndi_allow": ("0.0.0.0/0",)}, "ndi_allow"),
        ({"ndi_model": "two\rlines"}, "ndi_model"),
    ],
)
def test_settings_that_make_no_sense(wrong: dict[str, object], name: str):
    with pytest.raises(ValidationError, match=name):
        Settings(**wrong)


def test_settings_that_do(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("LUMILINE_NDI_PART_NUMBERS", '{"8700340": "probe"}')
    settings = Settings(ndi_host="10.0.0.1", ndi_allow=("10.0.0.0/24",))
    assert settings.ndi_part_numbers == {"8700340": "probe"}
