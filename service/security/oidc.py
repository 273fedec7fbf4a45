"""Tokens of an identity provider (OpenID Connect): validation, and their principals."""

from datetime import UTC, datetime
from typing import Any, Final

import jwt

from service.principal import Principal, known_scopes
from service.problems.errors import Unauthenticated
from service.security.jwks import Jwks

ALGORITHMS: Final = (
    "RS256",
    "RS384",
    "RS512",
    "PS256",
    "PS384",
    "PS512",
    "ES256",
    "ES384",
    "EdDSA",
)
"""Signatures with a public key only: what is shared with the provider could be made by either."""

LEEWAY_S: Final = 30.0
"""Clocks may differ by so much."""
_MAX_CHARACTERS: Final = 8192
_LAST_MOMENT_S: Final = 253_402_300_799  # the year 9999


class OidcTokens:
    """Checks tokens of one issuer for one audience."""

    def __init__(self, issuer: str, audience: str, scope_claim: str, keys: Jwks) -> None:
        self._issuer = issuer
        self._audience = audience
        self._scope_claim = scope_claim
        self._keys = keys

    def principal(self, token: str) -> Principal:
        """Return the principal of a token.

        Raises:
            Unauthenticated: it is not valid here; the message says why, without the token.
            NotReady: the provider's keys cannot be had.
        """
        if len(token) > _MAX_CHARACTERS:
            raise Unauthenticated(f"the token has more than {_MAX_CHARACTERS} characters")
        try:
            claims = self._claims(token)
        except jwt.PyJWTError as error:
            # Its messages name what is wrong and repeat nothing of the token but its algorithm.
            raise Unauthenticated(f"the token is not valid: {_reason(error)}") from error
        subject = claims["sub"]
        if not isinstance(subject, str) or not subject:
            raise Unauthenticated("the token is not valid: its subject is no text")
        return Principal(
            "token",
            subject[:200],
            _name(claims),
            known_scopes(self._scopes(claims)),
            datetime.fromtimestamp(min(int(claims["exp"]) + LEEWAY_S, _LAST_MOMENT_S), UTC),
        )

    def _claims(self, token: str) -> dict[str, Any]:
        header = jwt.get_unverified_header(token)
        if header.get("alg") not in ALGORITHMS:
            raise jwt.InvalidAlgorithmError(f"it must be signed by one of {', '.join(ALGORITHMS)}")
        kid = header.get("kid")
        key = self._keys.key(kid) if isinstance(kid, str) else None
        if key is None:
            raise jwt.InvalidKeyError("it is signed by a key that the issuer does not have")
        return jwt.decode(
            token,
            key=key,
            algorithms=list(ALGORITHMS),
            issuer=self._issuer,
            audience=self._audience,
            leeway=LEEWAY_S,
            options={"require": ["exp", "iss", "aud", "sub"]},
        )

    def _scopes(self, claims: dict[str, Any]) -> set[str]:
        scopes = claims.get(self._scope_claim)
        if isinstance(scopes, str):
            return set(scopes.split())
        if isinstance(scopes, list):
            return {item for item in scopes if isinstance(item, str)}
        return set()


def _name(claims: dict[str, Any]) -> str:
    for claim in ("preferred_username", "email", "name", "client_id"):
        if isinstance(claims.get(claim), str) and claims[claim]:
            return str(claims[claim])[:200]
    return str(claims["sub"])[:200]


def _reason(error: jwt.PyJWTError) -> str:
    return str(error)[:200] or type(error).__name__
