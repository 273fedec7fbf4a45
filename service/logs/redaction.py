"""Redacts keys and tokens in log lines.

Clients choose what is looked through, so every pattern takes time in proportion to its length: a
match begins only where its first words are, and no run of characters is tried from several places.
"""

import re
from typing import Final
from urllib.parse import unquote

_HIDDEN: Final = (
    # What begins like a key, also one that is cut or mistyped.
    (re.compile(r"lumi_[A-Za-z0-9]++_[A-Za-z0-9]++"), "lumi_***"),
    # JSON web tokens: the first part is an object in base64. Of what stands directly before, only
    # the first place in a word where one could begin is tried.
    (
        re.compile(
            r"(?<![A-Za-z0-9_-])(?>([A-Za-z0-9_-]*?)eyJ)[A-Za-z0-9_-]{5,}+"
            r"(?:\.[A-Za-z0-9_-]*+){1,4}"
        ),
        r"\1***",
    ),
    (re.compile(r"(?i)\b(bearer|basic)( |%20|\+)+[A-Za-z0-9._~+/=-]+"), r"\1 ***"),
    # The password of a database's URL, and values of query parameters that are named for one.
    (re.compile(r"(://[^\s:/@]*+):[^\s/]*@"), r"\1:***@"),
    (re.compile(r"(?i)\b((?:api_?key|access_token|token|key|password)=)[^\s&\"']+"), r"\1***"),
)

_ENCODED_TIMES: Final = 3


def redact(text: str) -> str:
    """Return the text with ``***`` in place of keys, tokens and passwords."""
    for pattern, replacement in _HIDDEN:
        text = pattern.sub(replacement, text)
    return text


def decoded(text: str) -> str:
    """Return a part of an address as it is meant: ``%5F``, and ``%255F``, hide an underscore."""
    for _ in range(_ENCODED_TIMES):
        text = unquote(text)
    return text
