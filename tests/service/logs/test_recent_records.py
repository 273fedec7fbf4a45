"""The newest log records, kept in memory and read over REST."""

import logging
from typing import Any

import pytest

from service.api.audit import log_records
from service.logs import ACCESS, MAX_RECENT, RecentRecords
from tests.service.fake_pipeline import TestClient

LOGGER = logging.getLogger("service.recent")


@pytest.fixture
def recent(monkeypatch: pytest.MonkeyPatch) -> Any:
    handler = RecentRecords()
    monkeypatch.setattr(log_records, "RECENT", handler)
    LOGGER.addHandler(handler)
    LOGGER.setLevel(logging.DEBUG)
    yield handler
    LOGGER.removeHandler(handler)


def test_newest_are_kept_without_secrets(recent: RecentRecords) -> None:
    for number in range(MAX_RECENT + 5):
        LOGGER.info("number %s with lumi_abcdefghij_0123456789", number, extra={"device": "sim"})
    kept = recent.newest()
    assert len(kept) == MAX_RECENT
    assert kept[-1].message == f"number {MAX_RECENT + 4} with lumi_***"
    assert kept[-1].device_id == "sim"


def test_requests_leave_room_for_the_rest(recent: RecentRecords) -> None:
    access = logging.getLogger(ACCESS)
    access.addHandler(recent)
    access.setLevel(logging.INFO)
    access.info("GET /api/v1/devices 200")
    access.warning("GET /api/v1/devices 500")
    access.removeHandler(recent)
    assert [one.level for one in recent.newest()] == ["warning"]


def test_a_line_that_cannot_be_formatted_breaks_nothing(
    recent: RecentRecords, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging, "raiseExceptions", False)
    LOGGER.info("%d", "no number")
    assert recent.newest() == []


def test_records_are_listed_newest_first_by_level_and_page(
    recent: RecentRecords, sqlite_client: TestClient
) -> None:
    for number in range(3):
        LOGGER.warning("warning %s", number)
    LOGGER.info("told")
    try:
        raise ValueError("wrong")
    except ValueError:
        LOGGER.exception("failed")
    address = "/api/v1/log-records?level=warning&limit=2"
    first = sqlite_client.get(address).json()
    assert [one["message"] for one in first["items"]] == ["failed", "warning 2"]
    assert "ValueError: wrong" in first["items"][0]["traceback"]
    more = sqlite_client.get(f"{address}&cursor={first['next_cursor']}").json()
    assert [one["message"] for one in more["items"]] == ["warning 1", "warning 0"]
