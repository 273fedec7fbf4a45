"""Format of API keys: generation, parsing, digest.

A key is ``lumi_<id>_<secret>``: the id, 12 letters and digits, finds it in the database; the
secret has 43 letters and digits, 256 bits from the operating system. What is random to 256 bits
cannot be tried out, so SHA-256 keeps it as well as a slow hash of passwords would, and costs a
request nothing.
"""

import hashlib
import re
import secrets
import string
from dataclasses import dataclass, field
from typing import Final

_ID_ALPHABET: Final = string.ascii_lowercase + string.digits
_SECRET_ALPHABET: Final = string.ascii_letters + string.digits
_ID_LENGTH: Final = 12
_SECRET_LENGTH: Final = 43

PREFIX: Final = "lumi_"
_FORM: Final = re.compile(r"lumi_([a-z0-9]{12})_[A-Za-z0-9]{43}", re.ASCII)


@dataclass(frozen=True)
class NewKey:
    """A key that was just made; ``text`` is shown once and kept nowhere."""

    id: str
    text: str = field(repr=False)

    @property
    def digest(self) -> str:
        """What is stored of it."""
        return digest(self.text)


def make_key() -> NewKey:
    """Make a key."""
    identity = "".join(secrets.choice(_ID_ALPHABET) for _ in range(_ID_LENGTH))
    secret = "".join(secrets.choice(_SECRET_ALPHABET) for _ in range(_SECRET_LENGTH))
    return NewKey(identity, f"{PREFIX}{identity}_{secret}")


def key_id_of(text: str) -> str | None:
    """Return the id in a key's text, None when it has not the form of a key."""
    found = _FORM.fullmatch(text)
    return None if found is None else found.group(1)


def digest(text: str) -> str:
    """Return the SHA-256 of a key's text, in hexadecimal digits."""
    return hashlib.sha256(text.encode()).hexdigest()
