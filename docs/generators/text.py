"""Markdown pieces that the generated pages share."""

from collections.abc import Iterable, Sequence


def cell(text: object) -> str:
    """Return a text as one table cell: on one line, with the bars escaped."""
    return " ".join(str(text).split()).replace("|", "\\|")


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """Return the lines of a table, none where there are no rows."""
    body = ["| " + " | ".join(cell(value) for value in row) + " |" for row in rows]
    if not body:
        return []
    return ["| " + " | ".join(head) + " |", "|" + "---|" * len(head), *body, ""]


def code(text: object) -> str:
    """Return a text in code font; nothing for an empty one."""
    return f"`{text}`" if str(text) else ""


def markdown(docstring: str) -> str:
    """Return a docstring's text with Markdown's code marks instead of reStructuredText's."""
    return docstring.replace("``", "`")


def page(title: str, source: str, lines: Iterable[str]) -> str:
    """Return a whole page, which says what it was made from."""
    head = [f"# {title}", "", f"*Generated from {source} when this site was built.*", ""]
    return "\n".join([*head, *lines]).rstrip() + "\n"
