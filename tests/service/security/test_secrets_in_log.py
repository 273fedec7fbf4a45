"""The log of a real server: right and wrong keys, and a database's password, are not in it."""

import logging
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest
from sqlalchemy.engine import make_url

from service.database.engine import Database
from service.database.migration import migrate
from service.principal import SCOPES
from service.security import store
from service.security.store import make_key
from tests.service.conftest import postgres_schema

PASSWORD = "s3cret-of-the-database"
TOKEN = "eyJhbGciOiJSUzI1NiIsImtpZCI6InIxIn0.eyJzdWIiOiJhIn0.c2lnbmF0dXJl"


@pytest.mark.slow
@pytest.mark.postgres
def test_no_secret_is_in_it(tmp_path: Path) -> None:
    schema = postgres_schema()
    url = make_url(next(schema)).set(password=PASSWORD)  # trusted anyway
    environment = {k: v for k, v in os.environ.items() if not k.startswith("LUMILINE_")} | {
        "LUMILINE_DATABASE_URL": url.render_as_string(hide_password=False),
        "LUMILINE_AUTHENTICATION": "required",
        "LUMILINE_DATA_DIR": str(tmp_path),
        "LUMILINE_LOG_LEVEL": "debug",
        "LUMILINE_COMPUTE_DEVICE": "cpu",
    }
    command = [sys.executable, "-m", "service.cli"]
    right, wrong = admin_key(url.render_as_string(hide_password=False)), make_key().text
    log = tmp_path / "log"
    with log.open("w") as output:
        server = subprocess.Popen(
            [*command, "serve", "--port", "0"], env=environment, stdout=output, stderr=output
        )
    try:
        base = wait_for_address(server, log)
        for key, status in ((right, 200), (wrong, 401), (TOKEN, 401), (right[:-1], 401)):
            headers = {"authorization": f"Bearer {key}"}
            assert httpx.get(f"{base}/api/v1/devices", headers=headers).status_code == status
            assert httpx.get(f"{base}/api/v1/devices?api_key={key}").status_code == 400
            answer = httpx.get(f"{base}/api/v1/devices/{key}", headers=headers)
            assert answer.status_code in (401, 404, 422)
        body = {"name": "another", "scopes": ["read:stream"]}
        headers = {"authorization": f"Bearer {right}"}
        another = httpx.post(f"{base}/api/v1/keys", json=body, headers=headers).json()["key"]
    finally:
        server.kill()
        server.wait(240.0)
        for _ in schema:
            pass
    text = log.read_text()
    assert "refused a log-in" in text
    secrets = [right, wrong, another, right[:-1]]
    hidden = [secret.rpartition("_")[2] for secret in secrets] + [TOKEN, PASSWORD]
    for secret in hidden:
        assert secret not in text


def admin_key(url: str) -> str:
    """Make a key in a new database without devices: the server has none to start."""
    database = Database(url)
    try:
        migrate(database)
        with database.write() as session:
            _, made = store.add_key(session, name="admin", scopes=SCOPES)
    finally:
        database.close()
    return made.text


def wait_for_address(server: "subprocess.Popen[bytes]", log: Path) -> str:
    end = time.monotonic() + 240.0
    while time.monotonic() < end and server.poll() is None:
        found = re.search(r"http://127\.0\.0\.1:\d+", log.read_text())
        if found is not None:
            return found.group()
        time.sleep(0.05)
    logging.error(log.read_text())
    raise AssertionError("the server did not start")
