"""Error codes of the common API that this server sends."""

from enum import IntEnum


class ErrorCode(IntEnum):
    """What is behind ``ERROR`` in a reply, in hexadecimal digits."""

    INVALID_COMMAND = 0x01
    TOO_LONG = 0x02
    TOO_SHORT = 0x03
    BAD_CRC = 0x04
    WRONG_PARAMETERS = 0x07
    INVALID_HANDLE = 0x08
    INVALID_PRIORITY = 0x09
    INVALID_LED = 0x0A
    INVALID_LED_STATE = 0x0B
    INVALID_IN_THIS_MODE = 0x0C
    NO_TOOL = 0x0D
    NOT_INITIALISED_HANDLE = 0x0E
    NOT_INITIALISED = 0x10
    CANNOT_INITIALISE = 0x15
    OUT_OF_RANGE = 0x23
    NOT_ALLOCATED = 0x2B
    ALL_ALLOCATED = 0x2D
    NO_SUCH_FEATURE = 0x33
    NO_SUCH_PARAMETER = 0x34
    WRONG_VALUE_TYPE = 0x35
    VALUE_OUT_OF_RANGE = 0x36
    READ_ONLY = 0x39


class CommandError(Exception):
    """A command is not carried out; its reply is the error.

    Args:
        code: what the client is told.
    """

    def __init__(self, code: ErrorCode) -> None:
        super().__init__(code.name)
        self.code = code
