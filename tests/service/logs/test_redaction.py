"""What is logged: keys, tokens and passwords are not in it."""

import logging

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from service.logs import TextFormatter, decoded, redact
from service.security.store import make_key

TOKEN = "eyJhbGciOiJSUzI1NiJ9.eyJzdWIiOiJhIn0.c2lnbmF0dXJl"


# What stands before looks like a key of which the true one is a part.
@example("lumi_", "")
@example("lumi_a", "")
@example("lumi_a_b_", "")
@given(st.text(max_size=40), st.text(max_size=40))
def test_a_key_is_hidden_wherever_it_stands(before: str, after: str) -> None:
    made = make_key()
    assert made.text.rpartition("_")[2] not in redact(f"{before}{made.text}{after}")
    assert TOKEN not in redact(f"{before}{TOKEN}{after}")


@pytest.mark.parametrize(
    ("line", "shown"),
    [
        ("Authorization: Bearer abc.def", "Authorization: Bearer ***"),
        ("GET /x?api_key=abc&device=sim", "GET /x?api_key=***&device=sim"),
        ("postgresql+psycopg://user:s3cret@host/db", "postgresql+psycopg://user:***@host/db"),
        ("postgresql://user@host/db?password=s3cret", "postgresql://user@host/db?password=***"),
        ("device sim: 12 frames lost", "device sim: 12 frames lost"),
        ("http://127.0.0.1:8000/docs", "http://127.0.0.1:8000/docs"),
        ("key lumi_abcdefghijkl is revoked", "key lumi_abcdefghijkl is revoked"),
    ],
)
def test_lines(line: str, shown: str) -> None:
    assert redact(line) == shown


HOSTILE = {
    "tokens that begin and begin": "eyJ",
    "tokens of many parts": "eyJaaaaa.",
    "keys that begin and begin": "lumi_",
    "keys without an end": "lumi_a",
    "schemes": "a.",
    "passwords": "://a:",
    "passwords without a slash": "://a:a",
    "bearers": "bearer ",
    "pluses": "+",
    "encoded blanks": "%20",
    "names": "key=",
    "blanks": " ",
    "at signs": "@",
    "dots": ".",
    "words": "aB3",
}
LENGTH = 300_000


# Were it quadratic, this would take minutes; it takes milliseconds.
@pytest.mark.slow
@pytest.mark.timeout(60)
@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("before", ["", "bearer", "lumi_", "eyJ", "://", "key"])
def test_the_work_grows_with_the_length_only(name: str, before: str) -> None:
    part = HOSTILE[name]
    redact(before + part * (LENGTH // len(part)))


@pytest.mark.parametrize("before", ["x", "eyJ", "eyJeyJ-", "a.", "é", "x.y.eyJ"])
def test_a_token_is_hidden_whatever_stands_before(before: str) -> None:
    shown = redact(f"{before}{TOKEN} after")
    assert not any(part in shown for part in TOKEN.split("."))
    assert shown.endswith("*** after")


@given(st.integers(0, 9))
def test_what_is_encoded_is_known(times: int) -> None:
    made = make_key()
    text = made.text
    for _ in range(times):
        text = text.replace("%", "%25").replace("_", "%5F")
    assert redact(decoded(text)) == "lumi_***"


@pytest.mark.parametrize("times", [1, 4, 9, 10, 11, 60])
def test_address_with_a_key_encoded_any_number_of_times_is_redacted(times: int) -> None:
    key = make_key().text
    text = "".join(f"%{ord(character):02X}" for character in key)
    text = text.replace("%", "%" + "25" * (times - 1))
    assert redact(decoded(f"/x?y={text}")) in ("/x?y=lumi_***", "***")


def test_address_with_encoded_digits_of_escapes_is_redacted() -> None:
    key = make_key().text.replace("_", "%25%35%46")
    assert redact(decoded(key)) == "lumi_***"


def test_tracebacks_are_redacted_too() -> None:
    made = make_key()
    try:
        raise ValueError(f"bad {made.text}")
    except ValueError as error:
        record = logging.LogRecord("x", logging.ERROR, "f", 1, "at %s", (TOKEN,), None)
        record.exc_info = (ValueError, error, error.__traceback__)
        text = TextFormatter().format(record)
    assert "ValueError: bad lumi_***" in text
    assert TOKEN not in text
