"""A typed client of a Lumiline server: REST resources, and streams as iterators."""

from lumiline.client.client import AsyncClient, Client
from lumiline.client.errors import (
    ClientError,
    ResourceChanged,
    ServerProblem,
    ServerUnreachable,
    StreamEnded,
    UnreadableMessage,
)

__all__ = [
    "AsyncClient",
    "Client",
    "ClientError",
    "ResourceChanged",
    "ServerProblem",
    "ServerUnreachable",
    "StreamEnded",
    "UnreadableMessage",
]
