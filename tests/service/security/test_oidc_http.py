"""Tokens of an identity provider whose documents come over HTTP, as they do in use."""

import json
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any

import jwt
import pytest
from jwt.algorithms import RSAAlgorithm

from service.application.app import create_app
from service.settings import Settings
from tests.service.fake_pipeline import FakePipeline, TestClient
from tests.service.security.conftest import bearer
from tests.service.security.test_oidc import AUDIENCE, OTHER_RSA, RSA, claims, public


class Provider(ThreadingHTTPServer):
    """Serves its configuration and keys."""

    asked: list[str]

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.asked = []
        self.issuer = f"http://127.0.0.1:{self.server_port}/realm"

    def document(self, path: str) -> Any:
        if path == "/realm/.well-known/openid-configuration":
            return {"issuer": self.issuer, "jwks_uri": f"{self.issuer}/keys"}
        if path == "/realm/keys":
            return {"keys": [public(RSA, RSAAlgorithm, "r1")]}
        return None

    def token(self, key: Any = RSA, **changes: Any) -> str:
        content = claims(iss=self.issuer) | changes
        return jwt.encode(content, key, "RS256", headers={"kid": "r1"})


class _Handler(BaseHTTPRequestHandler):
    server: Provider

    def do_GET(self) -> None:
        self.server.asked.append(self.path)
        document = self.server.document(self.path)
        self.send_response(404 if document is None else 200)
        self.send_header("content-type", "application/json")
        self.end_headers()
        self.wfile.write(json.dumps(document).encode())

    def log_message(self, *args: Any) -> None:
        """Say nothing."""


@pytest.fixture
def provider() -> Iterator[Provider]:
    with Provider() as server:
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        yield server
        server.shutdown()
        thread.join(240.0)


def test_a_token_opens_what_its_scopes_say(provider: Provider, sqlite_settings: Settings) -> None:
    settings = sqlite_settings.model_copy(
        update={
            "authentication": "required",
            "oidc_issuer": provider.issuer,
            "oidc_audience": AUDIENCE,
        }
    )
    with TestClient(create_app(settings, FakePipeline())) as client:

        def answer(method: str, path: str, token: str) -> int:
            found: int = client.request(method, path, headers=bearer(token)).status_code
            return found

        assert client.get("/api/v1/devices").status_code == 401
        assert answer("GET", "/api/v1/devices", provider.token()) == 200
        assert answer("POST", "/api/v1/devices/sim/stop", provider.token()) == 403
        all_of_it = provider.token(scope="read:stream operate:devices")
        assert answer("POST", "/api/v1/devices/sim/stop", all_of_it) == 200
        assert answer("GET", "/api/v1/devices", provider.token(aud="other")) == 401
        assert answer("GET", "/api/v1/devices", provider.token(exp=1)) == 401
        assert answer("GET", "/api/v1/devices", provider.token(key=OTHER_RSA)) == 401
        # The configuration and the keys, once each, whatever came.
        assert provider.asked == ["/realm/.well-known/openid-configuration", "/realm/keys"]
