"""Reference page of the stream's messages, from the client's message types."""

import dataclasses
import inspect
import typing

from generators.text import code, markdown, table
from generators.text import page as whole_page
from lumiline.client import messages


def page() -> str:
    """Return the page."""
    kinds = [kind for kind in typing.get_args(messages.Message) if dataclasses.is_dataclass(kind)]
    parts = [
        kind
        for _, kind in inspect.getmembers(messages, dataclasses.is_dataclass)
        if kind.__module__ == messages.__name__ and kind not in kinds
    ]
    lines = [
        "[The stream](../stream.md) says how it is opened and what the values mean. These are",
        "the members of each message as the Python client has them. Lengths are in mm, angles in",
        "rad, times in ns; a member whose type allows `None` may be null.",
        "",
        "## Messages",
        "",
    ]
    for kind in kinds:
        lines += _members(kind)
    lines += ["## Parts of a frame", ""]
    for kind in parts:
        lines += _members(kind)
    return whole_page("Messages of the stream", "`lumiline.client.messages`", lines)


def _members(kind: type) -> list[str]:
    rows = [
        (code(field.name), code(_name(field.type)), _default(field))
        for field in dataclasses.fields(kind)
    ]
    text = markdown(inspect.getdoc(kind) or "")
    return [f"### {kind.__name__}", "", text, "", *table(("member", "type", "if absent"), rows)]


def _name(annotation: object) -> str:
    if isinstance(annotation, str):
        return annotation
    if isinstance(annotation, type) and not typing.get_args(annotation):
        return annotation.__name__
    return str(annotation).replace(messages.__name__ + ".", "").replace("typing.", "")


def _default(field: "dataclasses.Field[object]") -> str:
    if field.default is not dataclasses.MISSING:
        return code(field.default)
    return "" if field.default_factory is dataclasses.MISSING else "empty"
