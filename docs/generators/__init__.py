"""Reference pages made from the code: REST, stream, command line, client, settings, problems."""

from collections.abc import Callable
from pathlib import Path

from generators import client, command_line, problems, rest, settings, stream

PAGES: dict[str, Callable[[], str]] = {
    "rest.md": rest.page,
    "stream-messages.md": stream.page,
    "command-line.md": command_line.page,
    "client.md": client.page,
    "settings.md": settings.page,
    "problems.md": problems.page,
}


def write_reference(folder: Path) -> None:
    """Write all pages; a page whose text has not changed keeps its time, for quick rebuilds."""
    folder.mkdir(exist_ok=True)
    for name, page in PAGES.items():
        path, text = folder / name, page()
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
