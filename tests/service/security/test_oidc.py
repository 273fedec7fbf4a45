"""Tokens of an identity provider: a local issuer whose keys this test makes."""

import json
import socket
import time
from collections.abc import Callable, Iterator
from threading import Event, Thread
from typing import Any

import jwt
import pytest
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from jwt.algorithms import ECAlgorithm, RSAAlgorithm
from pydantic import ValidationError

from service.problems.errors import NotReady, Unauthenticated
from service.security.jwks import CACHE_LIFETIME_S, RETRY_INTERVAL_S, Jwks, fetch
from service.security.oidc import LEEWAY_S, OidcTokens
from service.settings import Settings
from tests.service.security.conftest import Secured

ISSUER = "https://id.example"
AUDIENCE = "lumiline"
RSA = rsa.generate_private_key(public_exponent=65537, key_size=2048)
OTHER_RSA = rsa.generate_private_key(public_exponent=65537, key_size=2048)
EC = ec.generate_private_key(ec.SECP256R1())


def public(key: Any, algorithm: Any, kid: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(algorithm.to_jwk(key.public_key()))
    return found | {"kid": kid, "use": "sig"}


class Issuer:
    """Serves its configuration and keys, and counts how often they are asked for."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.fetched: list[str] = []
        self.answers = True
        self.issuer = ISSUER
        self.keys = [public(RSA, RSAAlgorithm, "r1"), public(EC, ECAlgorithm, "e1")]

    def get(self, url: str) -> bytes:
        self.fetched.append(url)
        if not self.answers:
            raise ValueError("no answer")
        if url.endswith("/.well-known/openid-configuration"):
            return json.dumps({"issuer": self.issuer, "jwks_uri": f"{ISSUER}/keys"}).encode()
        assert url == f"{ISSUER}/keys"
        return json.dumps({"keys": self.keys}).encode()

    def tokens(self, scope_claim: str = "scope") -> OidcTokens:
        keys = Jwks(ISSUER, None, get=self.get, clock=lambda: self.now)
        return OidcTokens(ISSUER, AUDIENCE, scope_claim, keys)


@pytest.fixture
def issuer() -> Issuer:
    return Issuer()


def claims(**changes: Any) -> dict[str, Any]:
    now = int(time.time())
    whole = {
        "iss": ISSUER,
        "aud": AUDIENCE,
        "sub": "user-7",
        "exp": now + 300,
        "iat": now,
        "scope": "openid read:stream write:calibrations",
        "preferred_username": "ada",
    } | changes
    return {name: value for name, value in whole.items() if value is not None}


def signed(
    content: dict[str, Any], key: Any = RSA, algorithm: str = "RS256", kid: str | None = "r1"
) -> str:
    return jwt.encode(content, key, algorithm, headers={} if kid is None else {"kid": kid})


@pytest.mark.parametrize(("key", "algorithm", "kid"), [(RSA, "RS256", "r1"), (EC, "ES256", "e1")])
def test_a_good_token(issuer: Issuer, key: Any, algorithm: str, kid: str) -> None:
    found = issuer.tokens().principal(signed(claims(), key, algorithm, kid))
    assert (found.kind, found.id, found.name) == ("token", "user-7", "ada")
    # What is no scope of ours means nothing here.
    assert found.scopes == {"read:stream", "write:calibrations"}
    assert found.expires_at is not None
    assert found.expires_at.timestamp() == pytest.approx(time.time() + 300 + LEEWAY_S, abs=5)


@pytest.mark.parametrize(
    ("value", "scopes"),
    [
        (["read:stream", "admin:keys", 7], {"read:stream", "admin:keys"}),
        ("read:calibration", {"read:calibration"}),
        ({"read:stream": True}, set()),
        (None, set()),
    ],
)
def test_scopes_come_from_the_claim_that_is_set(issuer: Issuer, value: Any, scopes: Any) -> None:
    token = signed(claims(scope="admin:devices", roles=value))
    assert issuer.tokens("roles").principal(token).scopes == scopes


def with_public_key_as_secret() -> str:
    """The known forgery: a shared-secret signature whose secret is the public key."""
    import base64
    import hashlib
    import hmac

    pem = RSA.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)

    def part(value: bytes) -> bytes:
        return base64.urlsafe_b64encode(value).rstrip(b"=")

    header = part(json.dumps({"alg": "HS256", "typ": "JWT", "kid": "r1"}).encode())
    body = header + b"." + part(json.dumps(claims()).encode())
    signature = hmac.new(pem, body, hashlib.sha256).digest()
    return (body + b"." + part(signature)).decode()


def tampered() -> str:
    header, _, signature = signed(claims()).split(".")
    body = signed(claims(scope="admin:keys")).split(".")[1]
    return f"{header}.{body}.{signature}"


BAD: dict[str, tuple[Callable[[], str], str]] = {
    "wrong issuer": (lambda: signed(claims(iss="https://evil.example")), "issuer"),
    "no issuer": (lambda: signed(claims(iss=None)), "iss"),
    "wrong audience": (lambda: signed(claims(aud="another")), "udience"),
    "no audience": (lambda: signed(claims(aud=None)), "aud"),
    "expired": (lambda: signed(claims(exp=int(time.time() - LEEWAY_S - 5))), "expired"),
    "no end": (lambda: signed(claims(exp=None)), "exp"),
    "an end that is none": (lambda: signed(claims(exp="soon")), "xpiration"),
    "not yet": (lambda: signed(claims(nbf=int(time.time() + LEEWAY_S + 60))), "not yet"),
    "no subject": (lambda: signed(claims(sub=None)), "sub"),
    "an empty subject": (lambda: signed(claims(sub="")), "subject"),
    "none": (lambda: jwt.encode(claims(), None, "none", headers={"kid": "r1"}), "RS256"),
    "shared secret": (
        lambda: signed(claims(), "s" * 64, "HS256"),
        "RS256",
    ),
    "public key as secret": (with_public_key_as_secret, "RS256"),
    "another's key": (lambda: signed(claims(), OTHER_RSA), "ignature"),
    "key of another kind": (lambda: signed(claims(), EC, "ES256", "r1"), "not valid"),
    "unknown key id": (lambda: signed(claims(), kid="r9"), "does not have"),
    "no key id": (lambda: signed(claims(), kid=None), "does not have"),
    "tampered": (tampered, "ignature"),
    "cut": (lambda: signed(claims())[:-20], "not valid"),
    "no token": (lambda: "a.b.c", "not valid"),
    "nothing": (lambda: "", "not valid"),
    "too long": (lambda: signed(claims(x="y" * 9000)), "8192"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_token_is_refused_and_not_repeated(issuer: Issuer, name: str) -> None:
    make, part = BAD[name]
    token = make()
    with pytest.raises(Unauthenticated, match=part) as refused:
        issuer.tokens().principal(token)
    if token:
        assert token not in refused.value.detail
        assert len(token) < 10 or token.split(".")[1] not in refused.value.detail


@pytest.mark.parametrize("late_s", [1.0, LEEWAY_S - 5.0])
def test_clocks_may_differ_a_little(issuer: Issuer, late_s: float) -> None:
    now = time.time()
    tokens = issuer.tokens()
    tokens.principal(signed(claims(exp=int(now - late_s), iat=int(now - 300))))
    tokens.principal(signed(claims(nbf=int(now + late_s), iat=int(now + late_s))))


def test_a_far_end_is_no_failure(issuer: Issuer) -> None:
    found = issuer.tokens().principal(signed(claims(exp=10**15)))
    assert found.expires_at is not None
    assert found.expires_at.year == 9999


def test_unknown_key_ids_cost_one_fetch_in_a_while(issuer: Issuer) -> None:
    tokens = issuer.tokens()
    tokens.principal(signed(claims()))
    assert len(issuer.fetched) == 2  # the configuration, and the keys
    for number in range(50):
        with pytest.raises(Unauthenticated):
            tokens.principal(signed(claims(), kid=f"unknown-{number}"))
    assert len(issuer.fetched) == 2
    # A key that is new there is found a little later.
    issuer.keys.append(public(OTHER_RSA, RSAAlgorithm, "r2"))
    with pytest.raises(Unauthenticated):
        tokens.principal(signed(claims(), OTHER_RSA, kid="r2"))
    issuer.now += RETRY_INTERVAL_S
    assert tokens.principal(signed(claims(), OTHER_RSA, kid="r2")).id == "user-7"
    assert len(issuer.fetched) == 3


def test_a_key_that_was_taken_back_is_refused_after_a_while(issuer: Issuer) -> None:
    tokens = issuer.tokens()
    tokens.principal(signed(claims()))
    issuer.keys = [public(EC, ECAlgorithm, "e1")]
    issuer.now += CACHE_LIFETIME_S + 1.0
    with pytest.raises(Unauthenticated, match="does not have"):
        tokens.principal(signed(claims()))


def test_keys_are_kept_while_the_issuer_does_not_answer(issuer: Issuer) -> None:
    tokens = issuer.tokens()
    issuer.answers = False
    with pytest.raises(NotReady, match="identity provider"):
        tokens.principal(signed(claims()))
    issuer.answers = True
    with pytest.raises(NotReady):  # not asked again so soon
        tokens.principal(signed(claims()))
    assert len(issuer.fetched) == 1
    issuer.now += RETRY_INTERVAL_S
    tokens.principal(signed(claims()))
    issuer.answers = False
    issuer.now += CACHE_LIFETIME_S + 1.0
    assert tokens.principal(signed(claims())).id == "user-7"


@pytest.mark.parametrize(
    "document",
    [
        {"issuer": ISSUER},
        {"issuer": ISSUER, "jwks_uri": 7},
        {"issuer": ISSUER, "jwks_uri": "http://id.example/keys"},
        {"issuer": ISSUER, "jwks_uri": "https://[keys"},
        {"issuer": ISSUER, "jwks_uri": "https://\x00/keys"},
        {},
        [],
        "text",
        None,
    ],
)
def test_a_configuration_that_makes_no_sense_is_no_answer(document: Any) -> None:
    def get(url: str) -> bytes:
        if url.endswith("openid-configuration"):
            return json.dumps(document).encode()
        return fetch(url)

    keys = Jwks(ISSUER, None, get=get)
    with pytest.raises(NotReady, match="identity provider"):
        keys.key("r1")
    # The next is not tried so soon, and no thread was left that keeps it from being.
    assert not keys._fetching


def test_a_provider_that_hangs_holds_nobody_up(issuer: Issuer) -> None:
    hangs, goes_on = Event(), Event()

    def get(url: str) -> bytes:
        if hangs.is_set():
            issuer.fetched.append(url)
            goes_on.wait(240.0)
        return issuer.get(url)

    keys = Jwks(ISSUER, None, get=get, clock=lambda: issuer.now, wait_s=0.05)
    assert keys.key("r1") is not None
    fetched = len(issuer.fetched)
    hangs.set()
    issuer.now += CACHE_LIFETIME_S + 1.0
    for _ in range(20):  # what is kept is used, and one asks for more
        assert keys.key("r1") is not None
        assert keys.key("unknown") is None
        issuer.now += RETRY_INTERVAL_S
    assert len(issuer.fetched) == fetched + 1
    issuer.keys.append(public(OTHER_RSA, RSAAlgorithm, "r2"))
    goes_on.set()
    end = time.monotonic() + 240.0
    while keys.key("r2") is None:
        assert time.monotonic() < end
        time.sleep(0.005)


def test_nothing_is_known_while_the_first_fetch_hangs() -> None:
    asked, goes_on = Event(), Event()

    def get(_: str) -> bytes:
        asked.set()
        goes_on.wait(240.0)
        return b"{}"

    keys = Jwks(ISSUER, None, get=get, wait_s=60.0)
    answers: list[str] = []

    def ask() -> None:
        try:
            keys.key("r1")
        except NotReady as error:
            answers.append(error.detail)

    first = Thread(target=ask)
    first.start()
    assert asked.wait(240.0)
    for _ in range(3):
        with pytest.raises(NotReady):
            keys.key("r1")
    assert answers == []  # the others were answered before it
    goes_on.set()
    first.join(240.0)
    assert len(answers) == 1


@pytest.fixture
def dripping() -> Iterator[str]:
    """The URL of a server that sends a byte now and then, of a head that never ends."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        stop = Event()

        def serve() -> None:
            connection, _ = server.accept()
            with connection:
                connection.sendall(b"HTTP/1.1 200 OK\r\nx-long: ")
                while not stop.wait(0.01):
                    try:
                        connection.sendall(b"a")
                    except OSError:
                        return

        thread = Thread(target=serve)
        thread.start()
        yield f"http://127.0.0.1:{server.getsockname()[1]}/keys"
        stop.set()
        thread.join(240.0)


def test_a_document_that_comes_byte_by_byte_is_given_up(
    dripping: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.security.jwks._FETCH_S", 0.2)
    with pytest.raises(TimeoutError):
        fetch(dripping)


def test_shared_secrets_among_the_keys_are_none(issuer: Issuer) -> None:
    issuer.keys = [{"kty": "oct", "k": "c2VjcmV0", "kid": "s1"}, *issuer.keys]
    tokens = issuer.tokens()
    tokens.principal(signed(claims()))
    with pytest.raises(Unauthenticated):
        tokens.principal(signed(claims(), "secret" * 8, "HS256", "s1"))


def test_a_configuration_of_another_issuer_is_not_believed(issuer: Issuer) -> None:
    issuer.issuer = "https://evil.example"
    with pytest.raises(NotReady):
        issuer.tokens().principal(signed(claims()))


def test_a_server_takes_them_beside_keys(
    secured: Secured, issuer: Issuer, monkeypatch: pytest.MonkeyPatch
) -> None:
    authenticator = secured.client.app.state.authenticator
    monkeypatch.setattr(authenticator, "_tokens", issuer.tokens())
    token = signed(claims(scope="read:stream operate:devices"))
    assert secured.ask("GET", "/api/v1/devices", token).status_code == 200
    refused = secured.ask("GET", "/api/v1/keys", token)
    assert (refused.status_code, "token user-7 (ada)" in refused.json()["detail"]) == (403, True)
    assert secured.ask("POST", "/api/v1/devices/sim/stop", token).status_code == 200
    entries = secured.ask("GET", "/api/v1/audit?actor_id=user-7", secured.key("read:audit")).json()
    assert entries["items"][0]["actor"] == {"kind": "token", "id": "user-7", "name": "ada"}
    assert secured.ask("GET", "/api/v1/devices", secured.key("read:stream")).status_code == 200
    wrong = secured.ask("GET", "/api/v1/devices", signed(claims(aud="another")))
    assert wrong.status_code == 401


@pytest.mark.parametrize(
    "wrong",
    [
        {"oidc_issuer": "https://id.example"},
        {"oidc_issuer": "http://id.example", "oidc_audience": "a"},
        {"oidc_issuer": "id.example", "oidc_audience": "a"},
        {"oidc_issuer": ISSUER, "oidc_audience": "a", "oidc_jwks_url": "http://id.example/keys"},
    ],
)
def test_settings_that_would_be_unsafe(wrong: dict[str, str]) -> None:
    with pytest.raises(ValidationError):
        Settings(**wrong)
