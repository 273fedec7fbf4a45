"""Errors of the protocol, sent to the client as STATUS or RTS_COMMAND."""

from compute.errors import LumilineError


class BadMessage(LumilineError):
    """Bytes that are no OpenIGTLink message, or content that is none of its type."""

    code = "openigtlink-bad-message"


class WrongChecksum(BadMessage):
    """A message's body is not what its checksum was computed of."""

    code = "openigtlink-wrong-checksum"


class CommandRefused(LumilineError):
    """A command that is not known, not allowed, or lacks what it needs."""

    code = "openigtlink-command-refused"
