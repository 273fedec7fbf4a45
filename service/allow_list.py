"""AllowList: who may connect to a port whose protocol knows no keys."""

from ipaddress import ip_address, ip_network


class AllowList:
    """Addresses of this machine, and of the networks that are named.

    Args:
        networks: as ``10.0.0.5`` or ``10.0.0.0/24``; settings have checked them.
    """

    def __init__(self, networks: tuple[str, ...] = ()) -> None:
        self._networks = tuple(ip_network(one) for one in networks)

    def permits(self, address: str) -> bool:
        """Return whether a client of this address may connect."""
        try:
            ip = ip_address(address.partition("%")[0])
        except ValueError:
            return False
        # As a socket of IPv6 tells of a client of IPv4.
        ip = getattr(ip, "ipv4_mapped", None) or ip
        return ip.is_loopback or any(ip in network for network in self._networks)
