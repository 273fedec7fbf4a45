"""Modules that run on a walk through the house, traced, and as docs/architecture.md lists them."""

import re
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "architecture.md"
_PACKAGES = ("compute", "hardware", "service")


class Trace:
    """Collects the modules of the packages of which functions are called while it is ``on``.

    Functions count, and properties; module bodies and what an import runs do not.
    """

    def __init__(self) -> None:
        self.on = False
        self.modules: set[str] = set()
        self._prefix = f"{ROOT}/"
        self._names: dict[str, str | None] = {}

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        """Take a call, as a profile function."""
        if not self.on or event != "call" or frame.f_code.co_name == "<module>":
            return
        file = frame.f_code.co_filename
        if file not in self._names:
            self._names[file] = self._module(file)
        name = self._names[file]
        if name is not None and name not in self.modules and not _imports(frame):
            self.modules.add(name)

    def _module(self, file: str) -> str | None:
        inside = file.removeprefix(self._prefix)
        if inside == file or inside.partition("/")[0] not in _PACKAGES:
            return None
        return inside.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def _imports(frame: FrameType | None) -> bool:
    """Whether a call comes from the body of a module that is being imported."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


@contextmanager
def tracing() -> Iterator[Trace]:
    """Trace this thread, and those that are started meanwhile."""
    trace = Trace()
    before = sys.getprofile()
    threading.setprofile(trace)
    sys.setprofile(trace)
    try:
        yield trace
    finally:
        trace.on = False
        sys.setprofile(before)
        threading.setprofile(None)


def listed(heading: str) -> list[str]:
    """Return the modules in the table below a heading of the page, in their order."""
    text = PAGE.read_text()
    section = text.split(f"\n### {heading}\n", 1)[1]
    section = re.split(r"\n##+ ", section, maxsplit=1)[0]
    return re.findall(r"^\| `([\w.]+)` \|", section, flags=re.MULTILINE)


def differences(ran: set[str], table: list[str]) -> str:
    """Return what the page lacks and what it has too much; empty: they agree."""
    assert len(set(table)) == len(table), "a module is listed twice"
    lacking, surplus = sorted(ran - set(table)), sorted(set(table) - ran)
    said = [f"not in the table: {name}" for name in lacking]
    return "\n".join(said + [f"did not run: {name}" for name in surplus])
