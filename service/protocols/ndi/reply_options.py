"""ReplyOption: what a client asks TX and BX for."""

from enum import IntFlag

from service.protocols.ndi.errors import CommandError, ErrorCode


class ReplyOption(IntFlag):
    """Bits of the parameter of TX and BX."""

    TRANSFORMS = 0x0001
    INFORMATION = 0x0002
    SINGLE_STRAY = 0x0004
    MARKERS = 0x0008
    OUT_OF_VOLUME = 0x0800
    STRAYS = 0x1000


def reply_option(text: str) -> ReplyOption:
    """Return the options of a command's text; without any, transforms.

    Raises:
        Refused: they are no four hexadecimal digits, or there are bits that mean nothing.
    """
    if not text:
        return ReplyOption.TRANSFORMS
    value = hexadecimal(text, 4)
    if value & ~int(_ALL):
        raise CommandError(ErrorCode.OUT_OF_RANGE)
    return ReplyOption(value)


def hexadecimal(text: str, digits: int) -> int:
    """Return the value of hexadecimal digits; raises CommandError."""
    if len(text) != digits:
        raise CommandError(ErrorCode.WRONG_PARAMETERS)
    if not all(one in "0123456789abcdefABCDEF" for one in text):
        raise CommandError(ErrorCode.OUT_OF_RANGE)
    return int(text, 16)


_ALL = (
    ReplyOption.TRANSFORMS
    | ReplyOption.INFORMATION
    | ReplyOption.SINGLE_STRAY
    | ReplyOption.MARKERS
    | ReplyOption.OUT_OF_VOLUME
    | ReplyOption.STRAYS
)
