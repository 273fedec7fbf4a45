"""Kalman updates on readings: joint over all sensors, or probabilistic by one sensor."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import PredictedMeasurements
from compute.tracking.motion_model import STATE_SIZE, CombinedState, ImmStates

Array = NDArray[np.float64]

_LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True, eq=False)
class Innovation:
    """Jacobians and covariances of the readings that update T tracks; others are masked.

    Args:
        used: shape (T, S).
        jacobian: d reading / d position, 0 where not used, shape (T, S, 3) [px/mm].
        variance: of the readings' noise [px^2], 1 where not used, shape (T, S).
        bias: covariance of the readings' constant errors, 0 where not used, shape (T, S, S).
    """

    used: NDArray[np.bool_]
    jacobian: Array
    variance: Array
    bias: Array

    @classmethod
    def of(
        cls, used: NDArray[np.bool_], jacobian: Array, variance: Array, bias: Array
    ) -> "Innovation":
        """Return the innovation with all readings masked that are not used.

        Args:
            used: shape (T, S).
            jacobian: d reading / d position, shape (T, S, 3) [px/mm].
            variance: variance of the readings' noise, shape (T, S) [px^2].
            bias: covariance of the readings' constant errors, shape (T, S, S) [px^2].
        """
        return cls(
            used,
            np.where(used[..., None], jacobian, 0.0),
            np.where(used, variance, 1.0),
            bias * used[:, :, None],
        )


def joint_update(
    states: ImmStates, innovation: Innovation, difference: Array
) -> tuple[ImmStates, Array, Array]:
    """Update the states by the chosen readings of all sensors at once.

    Args:
        states: of T tracks, predicted.
        innovation: of these tracks.
        difference: readings less predictions at each model's own mean, (T, M, S); 0 not used.

    Returns:
        The states, their probabilities not changed; the readings' log likelihood under each
        model, and their normalised innovation squared, both (T, M).
    """
    jacobian = innovation.jacobian[:, None]
    masked = states.bias_cross_covariance * innovation.used[:, None, None, :]
    across = states.covariance[..., :3] @ jacobian.swapaxes(-1, -2) + masked
    total = innovation_covariance(states.covariance, states.bias_cross_covariance, innovation)
    inverse = np.linalg.inv(total)
    gain = across @ inverse
    nis = np.einsum("tms,tmsr,tmr->tm", difference, inverse, difference)
    count = innovation.used.sum(axis=1)
    log = -0.5 * (nis + np.linalg.slogdet(total)[1] + _LOG_2PI * count[:, None])
    # Joseph's form: the difference of the covariances is negative by rounding where a track that
    # was lost, known to half a metre, is seen to a hundredth of a millimetre again.
    reduction = np.broadcast_to(np.eye(STATE_SIZE), states.covariance.shape).copy()
    reduction[..., :3] -= gain @ jacobian
    common = reduction @ masked @ gain.swapaxes(-1, -2)
    noise = (innovation.bias * innovation.used[:, None, :])[:, None].copy()
    diagonal = np.arange(jacobian.shape[-2])
    noise[..., diagonal, diagonal] += innovation.variance[:, None]
    covariance = reduction @ states.covariance @ reduction.swapaxes(-1, -2)
    covariance += gain @ noise @ gain.swapaxes(-1, -2) - common - common.swapaxes(-1, -2)
    bias_cross_covariance = states.bias_cross_covariance - gain @ (
        jacobian @ states.bias_cross_covariance[..., :3, :] + innovation.bias[:, None]
    )
    return (
        ImmStates(
            states.mean + (gain @ difference[..., None])[..., 0],
            0.5 * (covariance + covariance.swapaxes(-1, -2)),
            bias_cross_covariance,
            states.probability,
        ),
        log,
        nis,
    )


def update_by_readings(
    states: ImmStates,
    predicted: PredictedMeasurements,
    position_mm: Array,
    used: NDArray[np.bool_],
    position_px: Array,
    variance_px2: Array,
    bias: Array,
) -> tuple[ImmStates, Array, Array]:
    """Update the states by readings that are linearised at given positions.

    Args:
        states: of T tracks, predicted.
        predicted: predicted readings at the positions.
        position_mm: where to linearise, shape (T, 3) [mm].
        used: which readings count, shape (T, S).
        position_px: readings, shape (T, S) [px].
        variance_px2: variance of their noise, shape (T, S) [px^2].
        bias: covariance of the readings' constant errors, shape (T, S, S) [px^2].

    Returns:
        See ``joint_update``.
    """
    jacobian = predicted.jacobian_px_per_mm
    apart = states.mean[..., :3] - position_mm[:, None]
    expected = predicted.reading_px[:, None] + np.einsum("tsi,tmi->tms", jacobian, apart)
    difference = np.where(used[:, None], position_px[:, None] - expected, 0.0)
    return joint_update(states, Innovation.of(used, jacobian, variance_px2, bias), difference)


def log_evidence(probability: Array, log_likelihood: Array) -> Array:
    """Return the log likelihood of each track's readings under all models together, shape (T,).

    Args:
        probability: of the models before the readings, shape (T, M).
        log_likelihood: of the readings under each model, shape (T, M).
    """
    top = log_likelihood.max(axis=1)
    evidence = (probability * np.exp(log_likelihood - top[:, None])).sum(axis=1)
    log: Array = top + np.log(evidence)
    return log


def reading_variance(combined: CombinedState, jacobian: Array, sensor: int, bias: Array) -> Array:
    """Return the variance of one sensor's predicted readings, with its bias's own, shape (T,).

    Args:
        combined: the combined prediction of T tracks.
        jacobian: d reading / d position, shape (T, 3) [px/mm].
        sensor: index of the sensor.
        bias: variance of the sensor's constant error, shape (T,) [px^2].
    """
    variance: Array = np.einsum("ti,tij,tj->t", jacobian, combined.covariance[:, :3, :3], jacobian)
    cross = combined.bias_cross_covariance[:, :3, sensor]
    variance += 2.0 * np.einsum("ti,ti->t", jacobian, cross) + bias
    return variance


def innovation_covariance(
    covariance: Array, bias_cross_covariance: Array, innovation: Innovation
) -> Array:
    """Return the covariance of predictions and readings together, shape (T, M, S, S).

    Args:
        covariance: of the states, shape (T, M, 9, 9).
        bias_cross_covariance: their covariance with the sensors' biases, shape (T, M, 9, S).
        innovation: of the T tracks.
    """
    jacobian, used = innovation.jacobian[:, None], innovation.used[:, None, None, :]
    half = jacobian @ bias_cross_covariance[..., :3, :] * used
    total: Array = jacobian @ covariance[..., :3, :3] @ jacobian.swapaxes(-1, -2)
    total += half + half.swapaxes(-1, -2) + innovation.bias[:, None] * used
    diagonal = np.arange(jacobian.shape[-2])
    total[..., diagonal, diagonal] += innovation.variance[:, None]
    return total


def leave_one_out_residuals(
    combined: CombinedState, innovation: Innovation, difference: Array
) -> Array:
    """Return each reading's residual from the prediction by all others, in standard deviations.

    With S the innovations' covariance and v their values, ``(S^-1 v)_s / sqrt((S^-1)_ss)`` is the
    error of predicting v_s by the others, over its standard deviation.

    Args:
        combined: the combined prediction of T tracks.
        innovation: of these tracks.
        difference: readings less predictions at the combined mean, (T, S); 0 where not used.

    Returns:
        Shape (T, S); 0 where not used.
    """
    total = innovation_covariance(
        combined.covariance[:, None], combined.bias_cross_covariance[:, None], innovation
    )[:, 0]
    inverse = np.linalg.inv(total)
    weighted = (inverse @ difference[..., None])[..., 0]
    diagonal = np.arange(difference.shape[1])
    return np.where(innovation.used, weighted / np.sqrt(inverse[:, diagonal, diagonal]), 0.0)


@dataclass(frozen=True, eq=False)
class PdaMixture:
    """Mixture of C association hypotheses of one sensor for each of T tracks (PDA).

    Args:
        weight: of the hypotheses, shape (T, C); the rest to 1 is that of a missed detection.
        difference: reading less prediction at the combined mean [px], shape (T, C).
        variance: of the reading's noise [px^2], shape (T, C).
    """

    weight: Array
    difference: Array
    variance: Array


def pda_update(
    states: ImmStates,
    combined: CombinedState,
    mixture: PdaMixture,
    sensor: int,
    jacobian: Array,
    bias: Array,
) -> ImmStates:
    """Update the states by one sensor's mixture of hypotheses (PDA).

    The mixture of all possible posteriors as one Gaussian: probabilistic data association
    (Y. Bar-Shalom, F. Daum, J. Huang, 10.1109/MCS.2009.934469). All lie along one direction, that
    of the gain, so that three numbers say it all.

    Args:
        states: of T tracks.
        combined: their mixture.
        mixture: the sensor's possible readings, with their probabilities.
        sensor: which one read.
        jacobian: d reading / d position, shape (T, 3).
        bias: the readings' constant errors' covariance with this sensor's, shape (T, S).
    """
    column = states.bias_cross_covariance[..., sensor]
    across = np.einsum("tmij,tj->tmi", states.covariance[..., :3], jacobian) + column
    predicted_variance = np.einsum("tmi,ti->tm", across[..., :3], jacobian)
    predicted_variance += np.einsum("tmi,ti->tm", column[..., :3], jacobian) + bias[:, sensor, None]
    apart = np.einsum("tmi,ti->tm", states.mean[..., :3] - combined.mean[:, None, :3], jacobian)
    difference = mixture.difference[:, None] - apart[..., None]
    total = predicted_variance[..., None] + mixture.variance[:, None]
    combined_variance = reading_variance(combined, jacobian, sensor, bias[:, sensor])
    combined_total = combined_variance[:, None] + mixture.variance
    # The weights are those under the combined state; each model scales them by its likelihood.
    log = -0.5 * (difference**2 / total + np.log(total))
    log -= (-0.5 * (mixture.difference**2 / combined_total + np.log(combined_total)))[:, None]
    likelihood = mixture.weight[:, None] * np.exp(np.minimum(log, 50.0))
    nothing = np.maximum(1.0 - mixture.weight.sum(axis=1), 0.0)
    sums = nothing[:, None] + likelihood.sum(axis=2)
    posterior_weight = likelihood / np.maximum(sums, 1e-300)[..., None]
    gain = posterior_weight / total
    shift = (gain * difference).sum(axis=2)
    information = gain.sum(axis=2)
    mixture_information = (posterior_weight * (difference / total) ** 2).sum(axis=2) - shift**2
    covariance = states.covariance - (information - mixture_information)[..., None, None] * (
        across[..., :, None] * across[..., None, :]
    )
    towards = (
        np.einsum("ti,tmis->tms", jacobian, states.bias_cross_covariance[..., :3, :])
        + bias[:, None]
    )
    probability = states.probability * np.maximum(sums, 1e-12)
    return ImmStates(
        states.mean + shift[..., None] * across,
        covariance,
        states.bias_cross_covariance
        - information[..., None, None] * across[..., :, None] * towards[..., None, :],
        probability / probability.sum(axis=1, keepdims=True),
    )
