"""Reference page of problem types (RFC 9457), from `service.problems.catalogue`."""

from generators.text import code, table
from generators.text import page as whole_page
from service.problems.catalogue import PROBLEM_TYPES


def page() -> str:
    """Return the page."""
    rows = [
        (code(code_name), kind.status, kind.title, kind.meaning)
        for code_name, kind in sorted(PROBLEM_TYPES.items())
    ]
    intro = [
        "A refused request is answered with `application/problem+json` (RFC 9457); its `type`",
        "ends in one of these codes. [Invalid input](../bad-input.md) has an example of each.",
        "",
    ]
    lines = [*intro, *table(("code", "status", "title", "meaning"), rows)]
    return whole_page("Problem types", "`service.problems`", lines)
