"""SingleCalibrationTap: what taps share that want one calibration and table in force all the time."""

from threading import Event

from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_batch import FrameBatch


class SingleCalibrationTap:
    """Remembers what the first batch was made with; ends when one was made otherwise."""

    def __init__(self) -> None:
        self.ended = Event()
        """Set when there is enough, or another calibration or table came into force."""
        self.switched = False
        """Whether another calibration or table came into force meanwhile."""
        self.in_force: tuple[str | None, str | None] | None = None
        """Calibration and table of the first batch; None: none came."""

    def prepare(self, found: ActiveCalibration) -> None:
        """Do nothing: the batches say what they were made with."""

    def _goes_on(self, batch: FrameBatch) -> bool:
        """Return whether all that came was made with the same, and more is wanted."""
        own = (batch.calibration_id, batch.table_id)
        if self.in_force is None:
            self.in_force = own
        if own != self.in_force:
            self.switched = True
            self.ended.set()
        return not self.ended.is_set()
