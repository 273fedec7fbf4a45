"""A server that needs keys, and keys for it."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import update

from service.application.app import create_app
from service.database.models import ApiKeyRow
from service.principal import Scope
from service.security import store
from service.settings import Settings
from tests.service.fake_pipeline import FakePipeline, TestClient


class Secured:
    """The server's client, and what an administrator does in its database."""

    def __init__(self, client: Any) -> None:
        self.client = client
        self.database = client.app.state.database

    def key(self, *scopes: Scope, name: str = "test") -> str:
        """Make a key."""
        with self.database.write() as session:
            _, made = store.add_key(session, name=name, scopes=scopes)
        return made.text

    def expired(self, *scopes: Scope) -> str:
        """Make a key that was valid once."""
        text = self.key(*scopes)
        past = datetime.now(UTC) - timedelta(seconds=1)
        with self.database.write() as session:
            query = update(ApiKeyRow).where(ApiKeyRow.id == key_id(text))
            session.execute(query.values(expires_at=past))
        return text

    def revoked(self, *scopes: Scope) -> str:
        """Make a key and revoke it."""
        text = self.key(*scopes)
        with self.database.write() as session:
            store.revoke_key(session, key_id(text))
        return text

    def ask(self, method: str, path: str, key: str | None = None, **options: Any) -> Any:
        """Send a request with a key."""
        headers = options.pop("headers", {}) | ({} if key is None else bearer(key))
        return self.client.request(method, path, headers=headers, **options)


def key_id(text: str) -> str:
    return text.split("_")[1]


def bearer(key: str) -> dict[str, str]:
    return {"authorization": f"Bearer {key}"}


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Secured]:
    settings = Settings(
        data_dir=tmp_path_factory.mktemp("secured"),
        authentication="required",
        failed_logins_per_minute=10_000,
    )
    with TestClient(create_app(settings, FakePipeline()), raise_server_exceptions=False) as client:
        yield Secured(client)
