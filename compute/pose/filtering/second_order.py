"""Second-order correction of predicted readings for a pose's uncertainty.

A filter that updates a pose known to a tenth of a radian by readings good to a hundredth of a
millimetre is wrong at once: the markers move on arcs and it follows the tangent, by far more than
the readings' noise, and then believes itself. The curvature's part is worked out at the points of a
cubature rule (I. Arasaratnam, S. Haykin, doi:10.1109/TAC.2009.2019800) and counts as uncertainty,
common to all readings as it is.
"""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.rotation import rotation_matrix
from compute.measurement.measurement_model import MeasurementModel
from compute.pose.centred_markers import CentredMarkers
from compute.pose.filtering.pose_filter import MeasurementPrediction, PoseState

Array = NDArray[np.float64]

CURVATURE_SIGMA_FRACTION: Final = 0.1
"""Of a reading's deviation: a curvature below it is left out."""
CUBATURE_RADIUS: Final = 6.0**0.5
"""Of the rule's points, in deviations."""


def needs_second_order(
    state: PoseState,
    centred: CentredMarkers,
    prediction: MeasurementPrediction,
    focal_px: float,
    sigma_px: float,
) -> bool:
    """Return whether the curvature may matter to readings of this deviation, roughly.

    Args:
        state: the tool.
        centred: its markers.
        prediction: its readings, as the linear model has them.
        focal_px: least principal distance of the cameras [px].
        sigma_px: least deviation of the readings [px].
    """
    diagonal = state.covariance.diagonal()
    # Along the reading: px per mm, and so the distance from the lens.
    gain = float(np.abs(prediction.jacobian[:, 3:]).max())
    turned = 0.5 * centred.radius_mm * float(diagonal[:3].sum())
    moved = float(diagonal[3:6].sum()) * gain / focal_px
    return (turned + moved) * gain > CURVATURE_SIGMA_FRACTION * sigma_px


def second_order_prediction(
    model: MeasurementModel,
    centred: CentredMarkers,
    lit: NDArray[np.intp],
    state: PoseState,
    prediction: MeasurementPrediction,
) -> MeasurementPrediction:
    """Return what readings are expected to be with the curvature's shift and uncertainty.

    Along each principal axis of the pose's uncertainty the even part of the readings' change is
    taken; as a variance it is counted three times what a Gaussian's would be along that axis, for
    the products of two axes that are not looked at.

    Args:
        model: the cameras.
        centred: the tool's markers.
        lit: which of them, shape (m,).
        state: the tool.
        prediction: its readings, as the linear model has them.
    """
    root = np.linalg.cholesky(state.covariance[:6, :6] + 1e-18 * np.eye(6))
    steps = CUBATURE_RADIUS * np.concatenate([root.T, -root.T])
    rotations = rotation_matrix(steps[:, :3]) @ state.rotation
    places = centred.markers_mm[lit] @ rotations.swapaxes(1, 2)
    places += (state.centroid_mm + steps[:, 3:])[:, None, :]
    value = model.linearise(places.reshape(-1, 3))[0].reshape(2, 6, -1)
    even = 0.5 * (value[0] + value[1]) - prediction.value_px
    if not np.isfinite(even).all():
        # Part of where it may be lies behind a lens: nothing can be said of its readings.
        return replace(prediction, value_px=np.full_like(prediction.value_px, np.nan))
    return replace(
        prediction,
        value_px=prediction.value_px + even.mean(axis=0),
        covariance=prediction.covariance + even.T @ even / 6.0,
    )
