"""Commands as PLUS writes them: one XML element with attributes, and the answer to it."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final
from xml.etree.ElementTree import ParseError
from xml.sax.saxutils import quoteattr

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from service.protocols.openigtlink.errors import CommandRefused

_SHOWN: Final = 200
_NOT_XML: Final = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True)
class CommandRequest:
    """A command.

    Args:
        name: what is to be done.
        attributes: of the element.
    """

    name: str
    attributes: Mapping[str, str]


@dataclass(frozen=True)
class CommandReply:
    """The answer to a command.

    Args:
        done: whether it was done.
        message: what was, or why it was not.
        values: single values, which clients of header version 2 get as metadata.
    """

    done: bool
    message: str
    values: Mapping[str, str] = field(default_factory=dict)


def read_command_request(name: str, text: str) -> CommandRequest:
    """Return the command that a text is.

    Args:
        name: what is to be done, where the message says so; else the element's ``Name`` does.
        text: ``<Command Name="..." .../>``; empty: no attributes.

    Raises:
        CommandRefused: it is no XML, declares entities or a document type, or is another element.
    """
    if not text.strip("\0 \t\r\n"):
        if not name:
            raise CommandRefused("a command without a name")
        return CommandRequest(name, {})
    try:
        element = fromstring(text.rstrip("\0"), forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError) as error:
        raise CommandRefused(
            f"the command is not XML that is read here: {error}"[:_SHOWN]
        ) from None
    if element.tag.lower() != "command":
        raise CommandRefused(f"the element is <{element.tag[:_SHOWN]}>; it must be <Command>")
    attributes = {str(key): str(value) for key, value in element.attrib.items()}
    found = name or attributes.get("Name", "")
    if not found:
        raise CommandRefused("a command without a name; give <Command Name=...>")
    return CommandRequest(found, attributes)


def write_reply(name: str | None, reply: CommandReply) -> str:
    """Return the answer as PLUS writes it.

    Args:
        name: of the command, for RTS_COMMAND; None: for STRING, whose form is older.
        reply: the answer.
    """
    shown = _clean(reply.message)
    parts = ["<CommandReply"]
    if name is not None:
        parts.append(f" Name={quoteattr(_clean(name))}")
    parts.append(f' Status="{"SUCCESS" if reply.done else "FAIL"}"')
    if name is not None and not reply.done:
        parts.append(f" Error={quoteattr(shown)}")
    parts.append(f" Message={quoteattr(shown)}")
    parts.append("></CommandReply>" if name is not None else " />")
    return "".join(parts)


def reply_metadata(reply: CommandReply) -> dict[str, str]:
    """Return what PLUS says of an answer in metadata, too."""
    found = {"Status": "SUCCESS" if reply.done else "FAIL", "Message": reply.message}
    if not reply.done:
        found["Error"] = reply.message
    return found | dict(reply.values)


def _clean(text: str) -> str:
    """Return a text without what XML cannot have."""
    return _NOT_XML.sub("?", text)
