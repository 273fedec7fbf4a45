"""For all tests here: a machine may stand still for a while, and poses do not get stale by it."""

import pytest


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.api.tools.pose_query.STALE_S", 600.0)
