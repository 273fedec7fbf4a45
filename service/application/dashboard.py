"""The dashboard: its page at ``/`` and the files that the page loads."""

from importlib.resources import files
from typing import Annotated, Final

from fastapi import APIRouter, Path
from starlette.exceptions import HTTPException
from starlette.responses import HTMLResponse, Response

_PAGE: Final = files("service.application") / "dashboard_page"
_MEDIA_TYPES: Final = {"js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}
_POLICY: Final = {
    # Pictures that need a key are fetched, and shown from blob: addresses.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; connect-src 'self'; "
    "style-src 'self'; img-src 'self' blob:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cache-Control": "no-cache",
}
_NOT_BUILT: Final = (
    '<!doctype html><html lang="en"><title>Lumiline</title><p>This source tree has no dashboard '
    'yet: <code>make dashboard</code> builds it. The interface is described at <a href="/docs">'
    "/docs</a>.</p></html>"
)

router = APIRouter(include_in_schema=False)


@router.get("/", name="dashboard")
def page() -> HTMLResponse:
    """Return the dashboard's page."""
    index = _PAGE / "index.html"
    if not index.is_file():
        return HTMLResponse(_NOT_BUILT, status_code=503)
    return HTMLResponse(index.read_text("utf-8"), headers=_POLICY)


@router.get("/dashboard/{name}", name="dashboard-file")
def page_file(
    name: Annotated[str, Path(pattern=r"^[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*$")],
) -> Response:
    """Return a file that the page loads; its name changes with its content."""
    file = _PAGE / "dashboard" / name
    if not file.is_file():
        raise HTTPException(404)
    return Response(
        file.read_bytes(),
        media_type=_MEDIA_TYPES.get(name.rpartition(".")[2], "application/octet-stream"),
        headers={"Cache-Control": "public, max-age=31536000, immutable"},
    )
