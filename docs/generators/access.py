"""Tables of scopes and operations in docs/how-to/security.md, from the code.

``python docs/generators/access.py`` writes them, with ``--check`` it only says whether the page is
up to date (exit status 1: it is not).
"""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

from fastapi.routing import iter_route_contexts

if __package__ in (None, ""):
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from generators.text import code, table
from service.application.app import create_app
from service.principal import SCOPE_MEANINGS, SCOPE_RISKS, SCOPES
from service.security.guard import operation_of
from service.security.operation_scopes import OPERATION_SCOPES, PUBLIC
from service.settings import Settings

PAGE = Path(__file__).resolve().parents[1] / "how-to" / "security.md"
_UNKNOWN_WEBSOCKET = "unknown_websocket"


def scopes() -> str:
    """Return the table of scopes."""
    rows = [(code(scope), SCOPE_MEANINGS[scope], SCOPE_RISKS[scope]) for scope in SCOPES]
    return "\n".join(table(("scope", "allows", "what its misuse can break"), rows))


def operations() -> str:
    """Return the table of operations, by scope: public ones first."""
    order = [PUBLIC, *SCOPES]
    requests = dict(_requests())
    rows = sorted(
        OPERATION_SCOPES.items(), key=lambda row: (order.index(row[1]), _sort_key(requests[row[0]]))
    )
    return "\n".join(
        table(
            ("operation", "request", "scope"),
            [
                (code(name), requests[name], scope if scope == PUBLIC else code(scope))
                for name, scope in rows
            ],
        )
    )


def _requests() -> Iterator[tuple[str, str]]:
    """Yield each operation with its method and path."""
    for route in iter_route_contexts(list(create_app(Settings.model_construct()).routes)):
        name = operation_of(route)
        path = re.sub(r":\w+}", "}", str(route.path))
        methods = (route.methods or set()) - {"HEAD"}
        method = min(methods) if methods else "websocket"
        yield name, f"{method} {'any other path' if name == _UNKNOWN_WEBSOCKET else path}"


def _sort_key(request: str) -> tuple[str, str]:
    method, _, path = request.partition(" ")
    return path, method


def page() -> str:
    """Return the page with up-to-date tables."""
    text = PAGE.read_text(encoding="utf-8")
    for name, made in (("scopes", scopes()), ("operations", operations())):
        begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
        head, rest = text.split(begin, 1)
        text = f"{head}{begin}\n\n{made}\n{end}{rest.split(end, 1)[1]}"
    return text


def main(arguments: list[str]) -> int:
    """Write the page, or check it."""
    new = page()
    if "--check" in arguments:
        return int(new != PAGE.read_text(encoding="utf-8"))
    PAGE.write_text(new, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
