"""Tool definitions that a client uploads: which of our tools is meant."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

MAX_BYTES: Final = 2048
"""What a handle has room for."""
BLOCK_BYTES: Final = 64
"""What one command uploads."""
NAME_CHARACTERS: Final = 20
"""Of part numbers."""

_MAGIC: Final = b"NDI"
_PART_NUMBER: Final = slice(592, 592 + NAME_CHARACTERS)
_TEXT: Final = re.compile(rb"[\x20-\x7e]+")


def names_in_definition(image: bytes) -> tuple[str, ...]:
    """Return the names that a tool definition could mean a tool by, at most 100.

    Of a definition file (``.rom``) it is the part number. Of anything else, all text in it: a
    file that holds a tool's name and nothing more will do.
    """
    searched = image[_PART_NUMBER] if image.startswith(_MAGIC) else image
    found = (part.strip().decode() for part in _TEXT.findall(searched))
    return tuple(dict.fromkeys(name for name in found if name))[:100]


def match_tool(
    names: Sequence[str], tools: Sequence[str], part_numbers: Mapping[str, str]
) -> str | None:
    """Return the tool that one of these names means; None: none does, or more than one.

    Args:
        names: as of ``names_in_definition``.
        tools: our tools.
        part_numbers: names of tools by what definitions call them.
    """
    known = {number.casefold(): tool for number, tool in part_numbers.items()}
    meant = {tool for name in names for tool in _tools_called(name.casefold(), tools, known)}
    return meant.pop() if len(meant) == 1 else None


def _tools_called(name: str, tools: Sequence[str], known: Mapping[str, str]) -> Iterator[str]:
    if name in known:
        yield known[name]
        return
    whole = [tool for tool in tools if tool.casefold() == name]
    cut = [tool for tool in tools if tool.casefold()[:NAME_CHARACTERS] == name]
    yield from whole or cut
