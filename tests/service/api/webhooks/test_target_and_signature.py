"""Which targets are refused; signatures as Standard Webhooks describes them."""

import asyncio
import base64
import hashlib
import hmac

import pytest

from service.api.webhooks.signature import make_secret, signed_headers
from service.api.webhooks.target import TargetRefused, check_url, resolve


@pytest.mark.parametrize(
    "url",
    [
        "https://alarm.example.org/hook", "https://8.8.8.8/hook", "http://127.0.0.1:9000/hook",
        "http://192.168.1.5/hook", "http://[::1]:80/", "http://alarm.local/hook?room=2",
    ],
)  # fmt: skip
def test_check_url_receiver_is_taken(url: str) -> None:
    assert check_url(url) == url


@pytest.mark.parametrize(
    ("url", "word"),
    [
        ("http://169.254.169.254/latest/meta-data", "link-local"),
        ("https://169.254.169.254/", "link-local"),
        ("https://[fe80::1]/", "link-local"),
        ("https://[::ffff:169.254.169.254]/", "link-local"),
        ("https://[fd00:ec2::254]/", "metadata"),
        ("https://100.100.100.200/", "metadata"),
        ("https://0.0.0.0/", "unspecified"),
        ("https://224.0.0.1/", "multicast"),
        ("http://8.8.8.8/hook", "https://"),
        ("ftp://example.org/", "https://HOST/PATH"),
        ("file:///etc/passwd", "https://HOST/PATH"),
        ("https:///nohost", "https://HOST/PATH"),
        ("https://user:secret@example.org/", "user or a password"),
        ("https://example.org/#x", "fragment"),
        ("https://example.org:0/", "port 0"),
        ("https://example.org:99999/", "no URL"),
        ("https://ex ample.org/", "no blank"),
        ("https://example.org/\x00", "no blank"),
        ("https://ex\u00e4mple.org/", "ASCII"),
    ],
)
def test_check_url_others_are_refused_with_what_would_be_right(url: str, word: str) -> None:
    with pytest.raises(TargetRefused, match="(?s).*" + word.replace("/", "/")):
        check_url(url)


def _resolving(monkeypatch: pytest.MonkeyPatch, *addresses: str) -> None:
    monkeypatch.setattr("service.api.webhooks.target.lookup", lambda _: addresses)


def test_resolve_name_that_leads_to_metadata_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    _resolving(monkeypatch, "169.254.169.254")
    with pytest.raises(TargetRefused, match="link-local"):
        asyncio.run(resolve("https://rebinding.example.org/"))


def test_resolve_plain_http_leaves_no_private_network(monkeypatch: pytest.MonkeyPatch) -> None:
    _resolving(monkeypatch, "93.184.216.34")
    with pytest.raises(TargetRefused, match="outside of private networks"):
        asyncio.run(resolve("http://alarm.example.org/"))
    assert [str(one) for one in asyncio.run(resolve("https://alarm.example.org/"))] == [
        "93.184.216.34"
    ]


def test_resolve_name_of_several_addresses_keeps_those_that_are_allowed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _resolving(monkeypatch, "fe80::1%eth0", "::1", "93.184.216.34", "192.168.1.5")
    found = asyncio.run(resolve("http://alarm.example.org/"))
    assert [str(one) for one in found] == ["::1", "192.168.1.5"]


def test_signed_headers_published_example_is_verified() -> None:
    """The example of the specification's reference libraries."""
    secret = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"
    headers = signed_headers(
        secret, "msg_p5jXN8AQM9LWM0D4loKWxJek", 1614265330, b'{"test": 2432232314}'
    )
    assert headers["webhook-signature"] == "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE="


def test_make_secret_is_another_each_time_and_long() -> None:
    first, second = make_secret(), make_secret()
    assert first != second
    assert len(base64.b64decode(first.removeprefix("whsec_"))) == 32
    body = b"{}"
    headers = signed_headers(first, "msg_1", 5, body)
    digest = hmac.new(
        base64.b64decode(first.removeprefix("whsec_")), b"msg_1.5.{}", hashlib.sha256
    ).digest()
    assert headers["webhook-signature"] == f"v1,{base64.b64encode(digest).decode()}"
    assert signed_headers(first, "msg_1", 6, body) != headers
