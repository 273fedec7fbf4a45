"""Settings of the search and of detection: numbers that size arrays must be whole."""

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.detection.peak_detector import DetectionSettings


@pytest.mark.parametrize("value", [0, 2.5, 2.0, True, np.nan, "2", 10**6])
@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (CentroidSettings, "max_peaks"),
        (CentroidSettings, "min_width_px"),
        (DetectionSettings, "max_peaks"),
    ],
)
def test_what_is_no_whole_number_in_range_is_refused(kind, name, value):
    with pytest.raises(InvalidParameter, match=f"{name} is {value!r}; it must be a whole number"):
        kind(**{name: value})


def test_whole_numbers_of_numpy_are_taken():
    assert CentroidSettings(max_peaks=np.int64(3), min_width_px=np.int32(1)).max_peaks == 3
