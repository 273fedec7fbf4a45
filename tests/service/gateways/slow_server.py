"""The command `lumiline` with calibration runs that can be made to wait."""

from service.api.runs.kinds import calibration
from service.cli import app
from tests.service.gateways import slow_calibration

if __name__ == "__main__":
    calibration.compute = slow_calibration.compute
    app()
