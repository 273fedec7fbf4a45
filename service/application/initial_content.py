"""First content of a new database: the simulated device "sim" with its nominal calibration."""

from typing import Final

import numpy as np
from sqlalchemy.orm import Session

from compute.calibration.calibrate import QUANTISATION_PX
from compute.calibration.result import Calibration, SensorFit
from compute.camera.model import PARAMETER_COUNT
from hardware.simulated.simulated_rig import PITCH_UM, simulated_sensor_models
from service.api.calibrations.schema import CalibratedProfile
from service.api.calibrations.store import activate, add_nominal
from service.api.devices.schema import NewDevice, Sensor, SimulatedSource
from service.api.devices.store import add_device

DEVICE_ID: Final = "sim"
NOTE: Final = "The simulator's own camera models, taken as exact; nothing was measured."

_VARIANCE: Final = 1e-12  # of every parameter: invertible, and far below any calibration's


def nominal_calibration() -> Calibration:
    """Return the simulator's true camera models as a calibration without residuals."""
    models = simulated_sensor_models()
    fits = tuple(
        SensorFit(model, 0, 0.0, 0.0, float(QUANTISATION_PX), "assumed", None) for model in models
    )
    covariance = _VARIANCE * np.eye(PARAMETER_COUNT * len(models))
    return Calibration("metric", fits, tuple(tuple(row) for row in covariance.tolist()), ())


def seed(session: Session) -> None:
    """Store the simulated device and its active nominal calibration."""
    device = NewDevice(
        id=DEVICE_ID,
        title="Simulated sensor bar with a rotating bar of two markers",
        source=SimulatedSource(kind="simulated"),
        autostart=True,
    )
    result = nominal_calibration()
    sensors = [Sensor(model.name, model.pixels, PITCH_UM) for model in result.models]
    add_device(session, device, sensors)
    store_nominal(session, DEVICE_ID, result, NOTE)


def store_nominal(
    session: Session,
    device_id: str,
    result: Calibration,
    note: str,
    profile: CalibratedProfile | None = None,
) -> None:
    """Store a calibration that was not measured as the device's active one, ``ID-nominal``."""
    identity = f"{device_id}-nominal"
    activate(session, add_nominal(session, device_id, result, note, identity, profile).id)
