"""Paired points of a registration, from mappings by name."""

from collections.abc import Mapping, Sequence

from lumiline.client import bodies
from lumiline.client.models import MeasuredPoint

Position = Sequence[float]


def paired_points(
    pairs: Mapping[str, tuple[Position, Position | MeasuredPoint]],
) -> list[bodies.Fiducial]:
    """Return the ``fiducials`` of ``create_registration``.

    Args:
        pairs: by name: a point's position in the frame, and its measured position [mm], which
            ``measure_point`` returns with its covariance.
    """
    return [
        {
            "name": name,
            "frame_mm": frame,
            "measured_mm": measured.position_mm,
            "measured_covariance_mm2": measured.covariance_mm2,
        }
        if isinstance(measured, MeasuredPoint)
        else {"name": name, "frame_mm": frame, "measured_mm": measured}
        for name, (frame, measured) in pairs.items()
    ]
