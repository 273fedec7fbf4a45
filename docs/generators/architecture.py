"""Module list of docs/architecture.md: the first line of every module, by folder.

``python docs/generators/architecture.py`` writes it, with ``--check`` it only says whether the page
is up to date (exit status 1: it is not).
"""

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "architecture.md"
PACKAGES = ("compute", "hardware", "service", "lumiline")
BEGIN, END = "<!-- modules: begin -->", "<!-- modules: end -->"


def first_line(path: Path) -> str:
    """Return the first line of a module's docstring, with nothing in it that Markdown reads."""
    text = (ast.get_docstring(ast.parse(path.read_text())) or "").partition("\n")[0]
    for mark in "\\*_<>|$[]":
        text = text.replace(mark, f"\\{mark}")
    return text.replace("``", "`")


def first_sentence(header: Path) -> str:
    """Return the first sentence of the comment at the head of a C++ header."""
    head = header.read_text().partition("#pragma once")[0]
    text = " ".join(line.removeprefix("//").strip() for line in head.splitlines())
    return text.partition(". ")[0].rstrip(". ") + "."


def module_list() -> str:
    """Return all packages as headings, with their modules and headers and first lines as lists."""
    lines: list[str] = []
    for package in PACKAGES:
        for folder in sorted({path.parent for path in (ROOT / package).rglob("*.py")}):
            modules = sorted(folder.glob("*.py"))
            own = folder / "__init__.py"
            about = first_line(own) if own.is_file() else ""
            lines += ["", f"### {folder.relative_to(ROOT)}", ""]
            if about:
                lines += [about, ""]
            lines += [f"- `{path.stem}`: {first_line(path)}" for path in modules if path != own]
            headers = sorted(folder.glob("*.h"))
            lines += [f"- `{path.name}`: {first_sentence(path)}" for path in headers]
    return "\n".join(lines).strip() + "\n"


def page() -> str:
    """Return the page with an up-to-date list."""
    text = PAGE.read_text()
    head, rest = text.split(BEGIN, 1)
    tail = rest.split(END, 1)[1]
    return f"{head}{BEGIN}\n\n{module_list()}\n{END}{tail}"


def main(arguments: list[str]) -> int:
    """Write the page, or check it."""
    new = page()
    if "--check" in arguments:
        return int(new != PAGE.read_text())
    PAGE.write_text(new)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
