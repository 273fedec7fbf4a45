"""GET /metrics."""

from typing import TYPE_CHECKING

from fastapi import APIRouter, Request
from starlette.responses import Response

if TYPE_CHECKING:
    from service.protocols.metrics.registry import Metrics

router = APIRouter(tags=["server"])


@router.get(
    "/metrics",
    operation_id="get-metrics",
    summary="Figures for Prometheus",
    response_class=Response,
    responses={
        200: {
            "content": {
                "text/plain": {"schema": {"type": "string"}},
                "application/openmetrics-text": {"schema": {"type": "string"}},
            }
        }
    },
)
def get_metrics(request: Request) -> Response:
    """All figures in Prometheus's text format, or OpenMetrics where `Accept` asks for it.

    docs/how-to/operation.md says which to watch.
    """
    metrics: Metrics = request.app.state.metrics
    content, media_type = metrics.text(request.headers.get("accept", ""))
    return Response(content, media_type=media_type)
