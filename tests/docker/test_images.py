"""The images' files say what they should, and the script that they start with does what it says.

Their whole way, from the install to a healthy service, is docker/check.sh, a step of .ci/run.
"""

import os
import re
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from service.settings import Settings

ROOT = Path(__file__).parents[2]
DOCKER = ROOT / "docker"
DOCKERFILES = [DOCKER / "Dockerfile", DOCKER / "Dockerfile.cuda"]
COMPOSE: dict[str, Any] = yaml.safe_load((DOCKER / "compose.yaml").read_text())


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_an_image_runs_as_nobody_special_and_tells_its_health(path: Path):
    text = path.read_text()
    steps = re.findall(r"^([A-Z]+) (.*)$", text, re.M)
    names = [name for name, _ in steps]
    assert dict(steps)["USER"] not in ("root", "0")
    assert names.index("USER") < names.index("ENTRYPOINT")
    assert "lumiline-healthcheck" in dict(steps)["HEALTHCHECK"]
    assert dict(steps)["ENTRYPOINT"] == '["lumiline-start"]'
    assert "docker/install.sh" in text
    assert "docker/prebuild.sh" in text
    assert dict(steps)["VOLUME"] == "/var/lib/lumiline"
    for name in re.findall(r"\b(LUMILINE_[A-Z_]+)=", text):
        assert name.removeprefix("LUMILINE_").lower() in Settings.model_fields


def test_what_is_copied_is_all_that_is_installed():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    packages = project["tool"]["setuptools"]["packages"]["find"]["include"]
    for ignored in ("Dockerfile.dockerignore", "Dockerfile.cuda.dockerignore"):
        kept = {line[1:] for line in (DOCKER / ignored).read_text().splitlines() if line[0] == "!"}
        assert kept >= {name.rstrip("*") for name in packages}
        assert kept >= {"lumiline", "docker", "pyproject.toml", "constraints.txt", "README.md"}
        assert "LICENSE" in kept
        assert not kept & {"shared", "tests", ".git"}


def test_compose_gives_the_service_to_this_machine_only_and_little_else():
    service = COMPOSE["services"]["lumiline"]
    assert all(port.startswith("127.0.0.1:") for port in service["ports"])
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["volumes"] == ["data:/var/lib/lumiline"]
    assert set(COMPOSE["volumes"]) == {"data", "database"}
    assert COMPOSE["services"]["database"].get("ports") is None
    for name in service["environment"]:
        assert name.removeprefix("LUMILINE_").lower() in Settings.model_fields
    # Longer than the server takes at most.
    from service.application.shutdown import STOP_WITHIN_S

    assert float(service["stop_grace_period"].removesuffix("s")) > STOP_WITHIN_S
    unit = (ROOT / "deploy" / "lumiline.service").read_text()
    assert float(re.findall(r"TimeoutStopSec=(\d+)", unit)[0]) > STOP_WITHIN_S


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="there is no systemd")
def test_the_unit_is_one(tmp_path: Path):
    text = (ROOT / "deploy" / "lumiline.service").read_text()
    unit = tmp_path / "lumiline.service"
    # What it starts is not installed here.
    unit.write_text(text.replace("/opt/lumiline/bin/lumiline-start", "/bin/true"))
    (tmp_path / "lumiline.service.d").mkdir()
    shutil.copy(ROOT / "deploy" / "devices.conf", tmp_path / "lumiline.service.d")
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(unit)], capture_output=True, text=True
    )
    complaints = [line for line in done.stderr.splitlines() if "lumiline.service" in line]
    assert (done.returncode, complaints) == (0, [])
    unit.write_text(unit.read_text().replace("ProtectSystem=strict", "ProtectSystm=strict"))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(unit)], capture_output=True, text=True
    )
    assert "ProtectSystm" in done.stderr


@pytest.mark.parametrize(
    "path", sorted((ROOT / "deploy").glob("*.service")), ids=lambda one: one.name
)
def test_unit_names_no_group_as_a_missing_one_would_keep_it_from_starting(path: Path):
    assert re.findall(r"^(?:Supplementary)?Groups?=.*", path.read_text(), re.M) == []


def test_group_of_the_devices_is_the_same_for_the_unit_and_the_cameras():
    """What docs/how-to/operation.md replaces on hosts where it has another name."""
    drop_in, rules = (ROOT / "deploy" / name for name in ("devices.conf", "60-lumiline.rules"))
    assert re.findall(r"^SupplementaryGroups=(.*)", drop_in.read_text(), re.M) == ["dialout"]
    assert re.findall(r'GROUP="(.*?)"', rules.read_text()) == ["dialout"]
    done = subprocess.run(
        ["sed", "s/dialout$/uucp/", str(drop_in)], capture_output=True, text=True, check=True
    )
    assert done.stdout.endswith("[Service]\nSupplementaryGroups=uucp\n")


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder as install.sh and prebuild.sh leave it, with a `lumiline` that tells what it got."""
    venv = tmp_path / "venv"
    (venv / "bin").mkdir(parents=True)
    shutil.copy(DOCKER / "start.sh", venv / "bin" / "lumiline-start")
    program = venv / "bin" / "lumiline"
    program.write_text('#!/bin/sh\necho "$WARP_CACHE_PATH|$MPLCONFIGDIR|$*"\n')
    program.chmod(0o755)
    cache = venv / "share" / "lumiline" / "cache"
    for part in ("warp", "matplotlib"):
        (cache / part).mkdir(parents=True)
        (cache / part / "built").write_text("first")
    (cache / "stamp").write_text("1")
    return venv


def start(venv: Path, data: Path) -> str:
    done = subprocess.run(
        [venv / "bin" / "lumiline-start", "keys", "list"],
        env={"PATH": os.environ["PATH"], "LUMILINE_DATA_DIR": str(data)},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


def test_a_start_finds_what_was_prebuilt_where_it_may_write(installed: Path, tmp_path: Path):
    data = tmp_path / "data"
    cache = data / "cache"
    assert start(installed, data) == f"{cache}/warp|{cache}/matplotlib|keys list"
    assert (cache / "warp" / "built").read_text() == "first"
    # What was built here since stays, also when the image is another.
    (cache / "warp" / "own").write_text("own")
    (cache / "warp" / "built").write_text("changed")
    start(installed, data)
    assert (cache / "warp" / "built").read_text() == "changed"
    built = installed / "share" / "lumiline" / "cache"
    (built / "warp" / "built").write_text("second")
    (built / "stamp").write_text("2")
    start(installed, data)
    assert (cache / "warp" / "built").read_text() == "second"
    assert (cache / "warp" / "own").read_text() == "own"


def test_a_start_without_a_data_directory_is_refused(installed: Path):
    done = subprocess.run(
        [installed / "bin" / "lumiline-start", "serve"],
        env={"PATH": os.environ["PATH"]},
        capture_output=True,
        text=True,
    )
    assert done.returncode != 0
    assert "LUMILINE_DATA_DIR" in done.stderr


HALL: dict[str, Any] = yaml.safe_load((DOCKER / "compose.hall.yaml").read_text())


def test_hall_runs_stations_without_ports_and_servers_for_this_machine_only():
    services = HALL["services"]
    for name in ("bar-1", "bar-2"):
        assert services[name]["command"] == ["station"]
        assert services[name]["environment"]["LUMILINE_STATION_NAME"] == name
        assert "ports" not in services[name]
    for name in ("gateway-1", "gateway-2"):
        assert services[name]["environment"]["LUMILINE_STATION"] == "none"
        assert all(port.startswith("127.0.0.1:") for port in services[name]["ports"])
    for name in ("bar-1", "bar-2", "gateway-1", "gateway-2"):
        assert services[name]["read_only"] is True
        assert services[name]["volumes"] == [f"{name}:/var/lib/lumiline"]
        for setting in services[name]["environment"]:
            assert setting.removeprefix("LUMILINE_").lower() in Settings.model_fields
    assert services["database"].get("ports") is services["nats"].get("ports") is None


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="there is no systemd")
def test_the_unit_of_a_station_is_one(tmp_path: Path):
    text = (ROOT / "deploy" / "lumiline-station.service").read_text()
    unit = tmp_path / "lumiline-station.service"
    unit.write_text(text.replace("/opt/lumiline/bin/lumiline-start", "/bin/true"))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(unit)], capture_output=True, text=True
    )
    complaints = [line for line in done.stderr.splitlines() if "lumiline-station" in line]
    assert (done.returncode, complaints) == (0, [])
