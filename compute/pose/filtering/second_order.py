"""Second-order correction of predicted readings for a pose's uncertainty.

A filter that updates a pose known to a tenth of a radian by readings good to a hundredth of a
millimetre diverges: the markers move on arcs while it extrapolates along the tangent, with an error
far above the readings' noise, and then becomes overconfident. The second-order terms are evaluated
by a cubature rule (I. Arasaratnam, S. Haykin, doi:10.1109/TAC.2009.2019800) and added to the
covariance, common to all readings.
"""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.pose.filtering.pose_filter import MeasurementPrediction, PoseState
from compute.pose.rigid_body import CentredMarkers
from compute.transform import rotation_matrix

Array = NDArray[np.float64]

CURVATURE_SIGMA_FRACTION: Final = 0.1
"""Second-order terms below this fraction of a reading's standard deviation are neglected."""
CUBATURE_RADIUS: Final = 6.0**0.5
"""Distance of the cubature points from the mean, in standard deviations."""


def needs_second_order(
    state: PoseState,
    centred: CentredMarkers,
    prediction: MeasurementPrediction,
    focal_px: float,
    sigma_px: float,
) -> bool:
    """Return whether second-order terms may matter, by a rough estimate.

    Args:
        state: the tool's state.
        centred: its markers.
        prediction: its readings, predicted by the linear model.
        focal_px: smallest principal distance of the cameras [px].
        sigma_px: smallest standard deviation of the readings [px].
    """
    diagonal = state.covariance.diagonal()
    # In px per mm; with the principal distance it gives the distance from the lens.
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
    """Return predicted readings with second-order bias and covariance.

    Along each principal axis of the pose's uncertainty the even part of the readings' change is
    evaluated. Its variance counts three times that of a Gaussian along the axis, in place of the
    products of two axes, which are not evaluated.

    Args:
        model: the cameras.
        centred: the tool's markers.
        lit: indices of the markers, shape (m,).
        state: the tool's state.
        prediction: its readings, predicted by the linear model.
    """
    root = np.linalg.cholesky(state.covariance[:6, :6] + 1e-18 * np.eye(6))
    steps = CUBATURE_RADIUS * np.concatenate([root.T, -root.T])
    rotations = rotation_matrix(steps[:, :3]) @ state.rotation
    positions = centred.markers_mm[lit] @ rotations.swapaxes(1, 2)
    positions += (state.centroid_mm + steps[:, 3:])[:, None, :]
    value = model.linearise(positions.reshape(-1, 3))[0].reshape(2, 6, -1)
    even = 0.5 * (value[0] + value[1]) - prediction.value_px
    if not np.isfinite(even).all():
        # Some cubature points lie behind a lens: the readings are undefined.
        return replace(prediction, value_px=np.full_like(prediction.value_px, np.nan))
    return replace(
        prediction,
        value_px=prediction.value_px + even.mean(axis=0),
        covariance=prediction.covariance + even.T @ even / 6.0,
    )
