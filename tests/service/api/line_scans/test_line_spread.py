"""A line's own shape, given by the client: lopsided lines, and lines that change by place."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from service.api.line_scans.line_spread import MAX_VALUES, Shape
from service.api.line_scans.methods import FitMethod
from service.api.line_scans.noise import line_noise
from service.api.line_scans.peak_search import find_peaks
from service.api.line_scans.plot import draw_scan
from tests.service.api.line_scans.scan_lines import NOISE, noisy

PATH = "/api/v1/line-scans"
CELLS = 16
FIRST_PX = -6.0
PIXELS = 512


def lopsided(tail_px: float) -> NDArray[np.float64]:
    """Cells of a line whose light falls off slowly to the right; its position is its top."""
    edges = np.arange(-6 * CELLS, 14 * CELLS) / CELLS
    place = edges + 0.5 / CELLS
    return np.exp(-0.5 * (np.minimum(place, 0.0) / 0.6) ** 2 - np.maximum(place, 0.0) / tail_px)


def shape(*tails_px: float, **more: Any) -> dict[str, Any]:
    rows = [lopsided(tail).tolist() for tail in tails_px]
    return {"light": rows, "first_px": FIRST_PX, "step_px": 1.0 / CELLS, **more}


def line(places: dict[float, float], seed: int = 3) -> NDArray[np.uint16]:
    """A line with one lopsided peak of 20,000 counts at each place, with the tail given."""
    pixel = np.arange(PIXELS + 1) - 0.5
    counts = np.full(PIXELS, 30.0)
    for place, tail in places.items():
        cells = lopsided(tail)
        edges = FIRST_PX + place + np.arange(len(cells) + 1) / CELLS
        below = np.interp(pixel, edges, np.concatenate([[0.0], np.cumsum(cells)]) / cells.sum())
        counts += 20_000.0 * np.diff(below)
    return noisy(counts, seed)


WIDE = NOISE.model_copy(update={"full_scale_counts": 65535})


def test_a_given_shape_is_read_where_a_gaussian_is_not(sqlite_client: Any) -> None:
    values = line({100.3: 2.0, 180.0: 2.0, 183.7: 2.0})
    request = {"scans": [values.tolist()], "noise": WIDE.model_dump()}

    def found(method: dict[str, Any]) -> list[dict[str, Any]]:
        answer = sqlite_client.post(PATH, json=request | {"method": {"method": "fit", **method}})
        assert answer.status_code == 200, answer.text
        peaks: list[dict[str, Any]] = answer.json()["scans"][0]["peaks"]
        return peaks

    own = found({"shape": shape(2.0)})
    assert len(own) == 3
    for peak, place in zip(own, (100.3, 180.0, 183.7), strict=True):
        assert abs(peak["position_px"] - place) < 5.0 * peak["sigma_px"]
        assert "poor-fit" not in peak["flags"]
    even = found({})
    assert "poor-fit" in even[0]["flags"]
    assert abs(even[0]["position_px"] - 100.3) > 0.3


def test_the_answer_is_compute_s() -> None:
    values = line({100.3: 2.0, 400.2: 3.0})[None]
    given = Shape(**shape(1.5, 3.5, first_node_px=50.0, node_step_px=400.0))
    method = FitMethod(shape=given)
    assert (method.width_log_sigma, method.further_peaks) == (0.0, True)
    cells = np.array([lopsided(1.5), lopsided(3.5)])
    share = cells / cells.sum(axis=1, keepdims=True)
    place = np.arange(cells.shape[1]) / CELLS
    width = np.sqrt(np.mean(share @ place**2 - (share @ place) ** 2))
    assert given.width_px == pytest.approx(width)
    measured = LineSpreadFunction.from_cells(
        cells[None], FIRST_PX, 1 / CELLS, 50.0, 400.0, unit_px=width
    )
    batch = fit_scans(
        values, FitSettings(width_px=width, width_log_sigma=0.0), line_noise(WIDE), measured
    )
    peaks = find_peaks(values, method, WIDE).scans[0].peaks
    assert [peak.position_px for peak in peaks] == pytest.approx(
        batch.position_px[0, : batch.count[0]].tolist(), abs=1e-9
    )


def test_a_shape_by_place() -> None:
    """The tail grows along the sensor: both peaks come out with a row at each of two places."""
    values = line({100.3: 1.5, 400.2: 3.5})[None]
    by_place = FitMethod(shape=Shape(**shape(1.5, 3.5, first_node_px=100.0, node_step_px=300.0)))
    peaks = find_peaks(values, by_place, WIDE).scans[0].peaks
    assert len(peaks) == 2
    for peak, place in zip(peaks, (100.3, 400.2), strict=True):
        assert peak.sigma_px is not None
        assert abs(peak.position_px - place) < 5.0 * peak.sigma_px
        assert "poor-fit" not in peak.flags
    one = find_peaks(values, FitMethod(shape=Shape(**shape(1.5))), WIDE).scans[0].peaks
    assert any("poor-fit" in peak.flags for peak in one[1:])


@pytest.mark.slow
def test_windows_and_pictures_have_the_shape() -> None:
    values = line({100.3: 2.0})
    method = FitMethod(shape=Shape(**shape(2.0)))
    found = find_peaks(values[None], method, WIDE, detail=True)
    windows = found.scans[0].windows
    assert windows is not None
    (window,) = windows
    rest = np.array([one for one in window.residual_sigma if one is not None])
    assert np.mean(rest**2) == pytest.approx(1.0, abs=0.6)
    picture = draw_scan(values, found, method, "line 0")
    # Drawn with a Gaussian's lines, the model would lie elsewhere.
    assert picture != draw_scan(values, found, FitMethod(), "line 0")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"light": [[1.0, 2.0]]}, "at least 3 items"),
        ({"light": []}, "at least 1 item"),
        ({"light": [[1.0, -2.0, 1.0]]}, "greater than or equal to 0"),
        ({"light": [[0.0, 0.0, 0.0]]}, "method.shape.light.0 has no light"),
        ({"light": [[1.0] * 40, [1.0] * 41]}, "rows of 40 and of 41 cells"),
        ({"light": [[1.0] * 4096] * 17}, f"it may have {MAX_VALUES}"),
        ({"light": [[0.0, 1.0, 0.0]]}, "standard deviation of 0 px"),
        ({"step_px": 10.0}, "it must be 0.25 to 16"),
        ({"step_px": 0.0}, "step_px"),
        ({"node_step_px": 0.0}, "node_step_px"),
        ({"colour": 1}, "colour"),
    ],
)
def test_what_is_refused(sqlite_client: Any, changes: dict[str, Any], words: str) -> None:
    method = {"method": "fit", "shape": shape(2.0) | changes}
    answer = sqlite_client.post(PATH, json={"scans": [[100] * 64], "method": method})
    assert answer.status_code == 422
    assert words in answer.json()["detail"]


def test_a_shape_has_its_width() -> None:
    with pytest.raises(InvalidParameter, match="width_px is given with shape"):
        FitMethod(shape=Shape(**shape(2.0)), width_px=1.0)
    free = FitMethod(shape=Shape(**shape(2.0)), width_log_sigma=0.1, further_peaks=False)
    assert (free.width_log_sigma, free.further_peaks) == (0.1, False)
    with pytest.raises(InvalidParameter, match="no light"):
        _ = Shape([[0.0, 0.0, 0.0]], 0.0, 0.1).width_px
