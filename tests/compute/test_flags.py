"""Names of flags."""

from compute.flags import flag_names
from compute.reconstruction.point_batch import PointFlag
from compute.signal.peaks import PeakFlag


def test_names_are_those_of_the_kind() -> None:
    """Flags of different kinds with the same value are equal, and have different names."""
    assert flag_names(PeakFlag(2)) == ("clipped",)
    assert flag_names(PointFlag(2)) == ("degenerate",)
    assert flag_names(PointFlag(0)) == ()
    both = PointFlag.TOO_FEW_SENSORS | PointFlag.NO_REDUNDANCY
    assert flag_names(both) == ("too-few-sensors", "no-redundancy")
