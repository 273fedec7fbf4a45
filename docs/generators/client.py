"""Reference page of the Python client, from the docstrings of `lumiline.client`."""

import inspect

import lumiline.client as package
from generators.text import page as whole_page


def page() -> str:
    """Return the page."""
    lines = [
        "Programs that use these are in [the Python client](../../how-to/client.md).",
        "",
    ]
    for name in ("Client", "AsyncClient"):
        lines += _directive("autoclass", f"lumiline.client.{name}", "inherited-members")
    lines += ["## Errors", ""]
    for name in package.__all__:
        value = getattr(package, name)
        if inspect.isclass(value) and issubclass(value, Exception):
            lines += _directive("autoexception", f"lumiline.client.{name}")
    return whole_page("Python client", "`lumiline.client`", lines)


def _directive(kind: str, name: str, *options: str) -> list[str]:
    title = [] if kind == "autoexception" else [f"## {name.rsplit('.', 1)[-1]}", ""]
    body = [f"   :{option}:" for option in ("members", *options)]
    return [*title, "```{eval-rst}", f".. {kind}:: {name}", *body, "```", ""]
