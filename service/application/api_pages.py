"""Documentation pages of the REST interface: Swagger UI and ReDoc, all of it served from here."""

from importlib.resources import files
from typing import Annotated, Final, Literal

from fastapi import APIRouter, Path
from starlette.responses import HTMLResponse, Response

_ASSETS: Final = files("fastapi_offline") / "static"
_OWN: Final = {
    "swagger-start.js": "SwaggerUIBundle({url: '/openapi.json', dom_id: '#swagger', "
    "deepLinking: true, presets: [SwaggerUIBundle.presets.apis], layout: 'BaseLayout'});\n",
    # The page's last image is its maker's logo, from elsewhere, which the policy keeps out.
    "redoc.css": "a[href*='redocly'] img {display: none}\n",
    "redoc-start.js": "Redoc.init('/openapi.json', {hideDownloadButton: true}, "
    "document.getElementById('redoc'));\n",
}
"""What starts the viewers: the policy forbids scripts inside a page."""
_MEDIA_TYPES: Final = {"js": "text/javascript", "css": "text/css", "png": "image/png"}
_POLICY: Final = {
    # Both viewers set styles on elements, and draw icons from data: addresses.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; connect-src 'self'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data:; font-src 'self' data:; "
    "worker-src blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
}
Asset = Literal[
    "swagger-ui-bundle.js",
    "swagger-ui.css",
    "redoc.standalone.js",
    "favicon.png",
    "swagger-start.js",
    "redoc-start.js",
    "redoc.css",
]

router = APIRouter(include_in_schema=False)


@router.get("/docs", name="swagger-ui")
def swagger_ui() -> HTMLResponse:
    """Return the page on which the interface's operations can be tried."""
    return _page("swagger", "swagger-ui-bundle.js", "swagger-start.js", "swagger-ui.css")


@router.get("/redoc", name="redoc")
def redoc() -> HTMLResponse:
    """Return the page to read about the interface."""
    return _page("redoc", "redoc.standalone.js", "redoc-start.js", "redoc.css")


@router.get("/docs/assets/{name}", name="api-page-asset")
def asset(name: Annotated[Asset, Path()]) -> Response:
    """Return a file that the pages load."""
    content = _OWN[name].encode() if name in _OWN else (_ASSETS / name).read_bytes()
    return Response(
        content,
        media_type=_MEDIA_TYPES[name.rpartition(".")[2]],
        headers={"Cache-Control": "public, max-age=3600"},
    )


def _page(element: str, *names: str) -> HTMLResponse:
    loads = "".join(
        f'<link rel="stylesheet" href="/docs/assets/{name}">'
        if name.endswith(".css")
        else f'<script defer src="/docs/assets/{name}"></script>'
        for name in names
    )
    return HTMLResponse(
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Lumiline REST</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<link rel="icon" href="/docs/assets/favicon.png">{loads}</head>'
        f'<body><div id="{element}"></div></body></html>',
        headers=_POLICY,
    )
