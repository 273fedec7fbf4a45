"""Reference page of the service's settings, from `service.settings`."""

from typing import Any

from pydantic.fields import FieldInfo

from generators.text import code, markdown, table
from generators.text import page as whole_page
from service.settings import Settings


def page() -> str:
    """Return the page."""
    rows = [
        (
            code(f"LUMILINE_{name.upper()}"),
            code(_type(field)),
            code(_default(field)),
            markdown(" ".join((field.description or "").split())),
        )
        for name, field in Settings.model_fields.items()
    ]
    intro = [
        "Every setting is an environment variable, or a member of the same name in lower case",
        "without `LUMILINE_` in `lumiline.toml` (another file: `LUMILINE_CONFIG`). Options of the",
        "command line come before variables, and variables before the file.",
        "",
    ]
    lines = [*intro, *table(("variable", "type", "default", "meaning"), rows)]
    return whole_page("Settings", "`service.settings`", lines)


def _type(field: FieldInfo) -> str:
    annotation: Any = field.annotation
    name = annotation.__name__ if isinstance(annotation, type) else str(annotation)
    return (
        name.replace("typing.", "")
        if "[" not in str(annotation)
        else str(annotation).replace("typing.", "")
    )


def _default(field: FieldInfo) -> str:
    if field.default_factory is not None:
        return "computed"
    return "none" if field.default is None else str(field.default)
