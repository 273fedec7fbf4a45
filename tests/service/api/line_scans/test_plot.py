"""The picture of a line: a PNG of its own for each line and method, whatever is in the line."""

import io
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from service.api.line_scans import plot, plot_panels
from service.api.line_scans.chain_steps import ChainMethod, Median, passive_chain
from service.api.line_scans.mask_method import MaskMethod, Template
from service.api.line_scans.methods import CentroidMethod, FitMethod, MatchedMethod, Method
from service.api.line_scans.peak_search import find_peaks
from service.api.line_scans.plot import draw_scan
from service.api.line_scans.plot_panels import panels_of
from service.api.line_scans.router import select_scan
from service.api.line_scans.schema import LineScan
from tests.compute.signal.synthetic_scans import gaussian_counts, measured, varied_lines
from tests.service.api.line_scans.scan_lines import NOISE, WIDTH, body, scenes

PATH = "/api/v1/line-scans.png"
FIT = {"method": "fit", "width_px": WIDTH}
METHODS: dict[str, Method] = {
    "centroid": CentroidMethod(),
    "fit": FitMethod(width_px=WIDTH),
    "slope": FitMethod(width_px=WIDTH, background="slope"),
    "chain": passive_chain(),
    "delayed": ChainMethod(line_filter=Median(aperture=4)),
    "matched": MatchedMethod(width_px=WIDTH),
    "mask": MaskMethod(template=Template([0.0, *[1.0] * 8, *[0.0] * 4, *[1.0] * 3], 8.0)),
}


def image(content: bytes) -> Image.Image:
    return Image.open(io.BytesIO(content))


def drawn(line: Any, method: Method) -> bytes:
    return draw_scan(line, find_peaks(line[None], method, NOISE, detail=True), method, "line 0")


@pytest.mark.slow
def test_lines_are_drawn_over_http(sqlite_client: Any) -> None:
    answers = [sqlite_client.post(f"{PATH}?scan={line}", json=body(FIT)) for line in (0, 1, 0)]
    assert {answer.status_code for answer in answers} == {200}
    assert {answer.headers["content-type"] for answer in answers} == {"image/png"}
    first, second, again = (answer.content for answer in answers)
    assert image(first).width == 1540
    assert 10_000 < len(first) < 300_000
    assert first == again
    assert first != second
    refused = sqlite_client.post(f"{PATH}?scan=2", json=body(FIT))
    assert refused.status_code == 422
    assert "scan is 2" in refused.json()["detail"]


@pytest.mark.slow
def test_an_averaged_line_is_drawn_with_its_others(sqlite_client: Any) -> None:
    lines = np.stack([scenes(seed)[0] for seed in range(4)])
    for line, first in ((0, 0), (1, 0), (2, 2), (3, 2)):
        assert np.array_equal(select_scan(lines, line, 2), lines[first : first + 2])
    request = body({"method": "chain", "average": 2}, scans=lines.tolist())
    assert sqlite_client.post(f"{PATH}?scan=3", json=request).status_code == 200


@pytest.mark.slow
def test_each_method_has_a_picture_of_its_own() -> None:
    found = [drawn(scenes()[0], method) for method in METHODS.values()]
    assert len(set(found)) == len(found)


@pytest.mark.slow
def test_more_panels_make_a_higher_picture() -> None:
    """No peak, one row of panels, two rows; of more than eight windows the brightest count."""
    rng = np.random.default_rng(2)
    heights = []
    for count in (0, 3, 12):
        places = 40.0 * (np.arange(count) + 1.3)
        counts = gaussian_counts(600, places, np.full(count, WIDTH), 100.0 + 50.0 * places)
        line = measured(counts.sum(axis=0, keepdims=True), rng, full=4095)[0]
        heights.append(image(drawn(line, METHODS["fit"])).height)
        scan = find_peaks(line[None], METHODS["fit"], NOISE, detail=True).scans[0]
        shown = [panel.numbers for panel in panels_of(600, scan, plot.MAX_PANELS)]
        assert len(scan.peaks) == count
        assert shown == [(number,) for number in range(max(count - 8, 0), count)]
    assert heights[0] < heights[1] < heights[2]


@pytest.mark.slow
def test_all_that_was_found_is_drawn() -> None:
    """A change of any of these makes another picture."""
    method, line = METHODS["fit"], scenes()[0]
    found = find_peaks(line[None], method, NOISE, detail=True)
    scan = found.scans[0]
    assert scan.windows is not None
    window, peak = scan.windows[0], scan.peaks[0]

    def with_window(**changes: Any) -> LineScan:
        return scan.model_copy(
            update={"windows": [window.model_copy(update=changes), *scan.windows[1:]]}
        )

    def with_peak(**changes: Any) -> LineScan:
        return scan.model_copy(update={"peaks": [peak.model_copy(update=changes), *scan.peaks[1:]]})

    changed = [
        scan,
        scan.model_copy(update={"background_counts": 300.0}),
        scan.model_copy(update={"limit_counts": 300.0}),
        with_window(residual_sigma=[2.0] * len(window.values)),
        with_window(light_counts=[1000.0]),
        with_peak(flags=("clipped",)),
        with_peak(position_px=peak.position_px + 5e-4),
    ]
    pictures = [
        draw_scan(line, found.model_copy(update={"scans": [one]}), method, "line 0")
        for one in changed
    ]
    assert len(set(pictures)) == len(changed)


def test_panels_are_of_neighbours_only() -> None:
    rng = np.random.default_rng(3)
    places = np.array([60.0, 68.0, 200.0, 300.0, 308.0, 316.0, 324.0, 332.0])
    counts = gaussian_counts(512, places, np.full(8, WIDTH), np.full(8, 900.0))
    line = measured(counts.sum(axis=0, keepdims=True), rng, full=4095)
    scan = find_peaks(line, CentroidMethod(), NOISE, detail=True).scans[0]
    shown = [panel.numbers for panel in panels_of(512, scan, 8)]
    assert shown == [(0, 1), (2,), (3, 4, 5, 6), (7,)]


def test_panels_hold_their_peaks() -> None:
    for name, method in METHODS.items():
        for line in scenes():
            scan = find_peaks(line[None], method, NOISE, detail=True).scans[0]
            shown = panels_of(len(line), scan, 8)
            assert sorted(k for panel in shown for k in panel.numbers) == [
                *range(len(scan.peaks))
            ], name
            for panel in shown:
                assert 0 <= panel.first_px < panel.last_px < len(line)
                for number in panel.numbers:
                    place = scan.peaks[number].position_px
                    assert panel.first_px <= place <= panel.last_px


def test_titles_say_positions_and_flags() -> None:
    scan = find_peaks(scenes(), METHODS["fit"], NOISE, detail=True).scans
    pair = next(p for p in panels_of(512, scan[0], 8) if len(p.numbers) == 2)
    rows = plot_panels._described(scan[0], pair)
    assert len(rows) == 3
    assert rows[0].startswith("2: 250.2")
    assert " ± 0.0" in rows[0]
    assert rows[2].startswith("χ²/dof")
    assert rows[2].endswith("joint")
    full = panels_of(512, scan[1], 8)[-1]
    assert "saturated" in plot_panels._described(scan[1], full)[-1]
    summary = plot._summary(scan[1], find_peaks(scenes(), METHODS["fit"]), [full], 512)
    assert summary.startswith("2 peaks fitted (1 saturated); the brightest 1 below")
    assert f"; {scan[1].saturated_pixels} of 512 pixels saturated" in summary
    assert "guessed" in summary


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1), st.sampled_from(sorted(METHODS)), st.sampled_from([64, 300]))
@settings(max_examples=6, deadline=None)
def test_any_line_has_a_picture(seed: int, name: str, pixels: int) -> None:
    rng = np.random.default_rng(seed)
    line = varied_lines(8, pixels, rng)[int(rng.integers(8))]
    found = find_peaks(line[None], METHODS[name], detail=True)
    assert image(draw_scan(line, found, METHODS[name], "line 0")).format == "PNG"


@pytest.mark.slow
def test_a_fit_that_was_not_possible_is_shown_as_such() -> None:
    """All of a peak saturated: no pixel is left to fit."""
    line = np.full(128, 100, np.uint16)
    for position in (10, 20, 60):
        line[position - 4 : position + 5] = 4095
    scan = find_peaks(line[None], METHODS["fit"], NOISE, detail=True).scans[0]
    assert "unfitted" in plot_panels._described(scan, panels_of(128, scan, 8)[-1])[-1]
    assert image(drawn(line, METHODS["fit"])).width == 1540
