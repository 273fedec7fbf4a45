"""`lumiline cameras`: what it lists, and what it says where there is nothing to list with."""

import json

import pytest
from typer.testing import CliRunner

import service.cli.cameras
from hardware.errors import MissingLibrary
from hardware.genicam.camera import DiscoveredCamera
from service.cli import app

ENTRY = DiscoveredCamera("Maker-Line2k-17", "10.0.0.5", "Maker", "Line2k", "17", "GigEVision")


def test_cameras_are_listed_for_people_and_machines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service.cli.cameras, "cameras", lambda: [ENTRY])
    shown = CliRunner().invoke(app, ["cameras"], env={"COLUMNS": "200"})
    assert shown.exit_code == 0
    assert "10.0.0.5" in shown.stdout
    listed = CliRunner().invoke(app, ["cameras", "--json"])
    assert json.loads(listed.stdout) == [
        {
            "camera": "Maker-Line2k-17",
            "address": "10.0.0.5",
            "vendor": "Maker",
            "model": "Line2k",
            "serial_number": "17",
            "protocol": "GigEVision",
        }
    ]


def test_no_camera_and_no_library_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service.cli.cameras, "cameras", list)
    assert "No camera answered" in CliRunner().invoke(app, ["cameras"]).stdout

    def missing() -> list[DiscoveredCamera]:
        raise MissingLibrary("GenICam cameras need the library Aravis")

    monkeypatch.setattr(service.cli.cameras, "cameras", missing)
    refused = CliRunner().invoke(app, ["cameras"])
    assert refused.exit_code == 2
    assert "need the library Aravis" in refused.stderr
