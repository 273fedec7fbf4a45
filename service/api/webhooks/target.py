"""Targets of webhooks: which URLs are taken, and to which addresses they may lead.

Whoever makes webhooks lets the server send requests into its network. Addresses that no receiver
has are refused: link-local ones, where clouds serve credentials (169.254.169.254), multicast and
unspecified ones. A name is resolved for each delivery and the request goes to an address that was
checked, so that a name cannot lead elsewhere a moment later.
"""

import asyncio
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Final
from urllib.parse import urlsplit

from hardware.name_lookup import lookup

Address = IPv4Address | IPv6Address

_METADATA: Final = frozenset({ip_address("fd00:ec2::254"), ip_address("100.100.100.200")})
"""Metadata services at addresses that are not link-local (AWS over IPv6, Alibaba)."""


class TargetRefused(ValueError):
    """A URL or an address that no request is sent to."""


def check_url(url: str) -> str:
    """Return a URL that events may be sent to.

    Raises:
        TargetRefused: it is none, with what would be right.
    """
    try:
        parts = urlsplit(url)
        port, host = parts.port, parts.hostname
    except ValueError as error:
        raise TargetRefused(f"it is no URL: {error}; give https://HOST/PATH") from None
    if parts.scheme not in ("https", "http") or not host:
        raise TargetRefused("it must be https://HOST/PATH, or http:// within a private network")
    if parts.username is not None or parts.password is not None:
        raise TargetRefused(
            "it has a user or a password, which logs would show; receivers check the signature"
        )
    if parts.fragment or port == 0 or not url.isascii() or not url.isprintable() or " " in url:
        raise TargetRefused("it must have no fragment, no blank and no port 0, in ASCII")
    try:
        address = ip_address(host)
    except ValueError:
        return url
    check_address(address, parts.scheme)
    return url


def check_address(address: Address, scheme: str) -> None:
    """Refuse an address that no request is sent to; raises TargetRefused."""
    mapped = getattr(address, "ipv4_mapped", None)
    address = mapped or address
    if (
        address.is_link_local
        or address.is_multicast
        or address.is_unspecified
        or address in _METADATA
    ):
        raise TargetRefused(
            f"{address} is a link-local, multicast, unspecified or metadata address; give the "
            "receiver's own"
        )
    if scheme == "http" and not (address.is_loopback or address.is_private):
        raise TargetRefused(
            f"{address} is outside of private networks, where http:// can be read and changed on "
            "the way; give https://"
        )


async def resolve(url: str) -> list[Address]:
    """Return the addresses of a URL's host that a request may be sent to, the preferred first.

    Raises:
        TargetRefused: all are refused.
        OSError, TimeoutError: the name is not known, or nobody answers in time.
    """
    parts = urlsplit(url)
    # The lookup has a time limit and keeps no pool busy: see there.
    found = await asyncio.to_thread(lookup, parts.hostname or "")
    addresses, refusals = [], []
    for text in found:
        address = ip_address(text.partition("%")[0])
        try:
            check_address(address, parts.scheme)
        except TargetRefused as refusal:
            refusals.append(refusal)
        else:
            addresses.append(address)
    if not addresses:
        raise refusals[0]
    return addresses
