"""Verdict and messages of a drift check."""

from math import degrees

from compute.calibration.drift.drift_detection import DriftCheck, SensorDrift
from service.api.drift_checks.schema import Verdict


def verdict_of(check: DriftCheck) -> Verdict:
    """Return the check's outcome in a word."""
    if check.good:
        return "good"
    if check.rigid_motion:
        return "moved-as-a-whole"
    return "sensors-moved" if moved_sensors(check) else "off"


def moved_sensors(check: DriftCheck) -> list[str]:
    """Return the sensors that moved by themselves."""
    if check.good or check.rigid_motion:
        return []
    return [sensor.sensor for sensor in check.sensors if sensor.moved]


def in_words(check: DriftCheck) -> list[str]:
    """Return the findings of a drift check, a sentence each."""
    chance = f"{check.dof} readings, chi2 {check.chi2:.4g}, p {check.p_value:.2g}"
    verdict = verdict_of(check)
    if verdict == "good":
        return [f"The calibration holds ({chance})."]
    said = [f"The calibration does not hold ({chance})."]
    if verdict == "moved-as-a-whole":
        assert check.rotation_rad is not None
        assert check.translation_mm is not None
        said.append(
            f"The markers, or the device, moved as a whole: turned by "
            f"{degrees(check.rotation_rad):.3g} degrees and shifted by {check.translation_mm:.3g} "
            "mm. Put them back; no sensor need have moved in the device."
        )
    elif verdict == "off":
        said.append("No single sensor stands out: are these the markers, at these positions?")
    else:
        said += [_moved(sensor) for sensor in check.sensors if sensor.moved]
    return said


def _moved(sensor: SensorDrift) -> str:
    text = f"Sensor {sensor.sensor} is off by {sensor.rms_px:.3g} px RMS: {sensor.description}"
    if sensor.change is not None and sensor.change_sigma is not None:
        text += f", by {_with_unit(sensor.parameter or '', sensor.change, sensor.change_sigma)}"
    return text + "."


def _with_unit(parameter: str, change: float, sigma: float) -> str:
    """Return a change with its sigma as text; angles in mrad."""
    unit = parameter.rpartition("_")[2]
    scale = 1e3 if unit == "rad" else 1.0
    name = "mrad" if unit == "rad" else unit
    return f"{scale * change:.3g} {name} (deviation {scale * sigma:.2g})"
