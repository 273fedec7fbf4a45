"""Reports: self-contained, escaped, and showing what the calibration says."""

import base64
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from compute.calibration.assessment.assess import calibrate_and_assess
from compute.calibration.result import measurement_sigma
from compute.calibration.settings import CalibrationSettings
from compute.camera.model import SensorGeometry
from compute.camera.stack import CameraStack
from compute.reconstruction.triangulation import reconstruct
from hardware.simulated.simulated_rig import WORKING_CENTRE_MM, simulated_sensor_models
from service.api.calibrations.comparison import CalibrationWithControlPoints, compare
from service.api.calibrations.examples import NEW_CALIBRATIONS
from service.api.calibrations.schema import LengthErrors
from service.api.reports import router
from service.api.reports.assembly import assemble_report
from service.api.reports.cache import ReportCache
from service.api.reports.content import ComparedCalibration, ReportContent
from service.api.reports.figures import FIGURES, draw
from service.api.reports.html import number
from service.api.reports.page import report_page, write_report
from service.api.reports.router import FigureName
from service.application.initial_content import nominal_calibration

EVIL = '<script>alert("1")</script> & $\\frac{1}$ €'
SIGMA_PX = 0.1


@pytest.fixture(scope="module")
def content() -> ReportContent:
    """A calibration with an exchanged label, compared with one of fewer points."""
    generator = np.random.default_rng(4)
    models = simulated_sensor_models()
    points = np.asarray(WORKING_CENTRE_MM) + generator.uniform(-120, 120, (40, 3))
    readings = CameraStack.of(models).project(points) + generator.normal(0, SIGMA_PX, (40, 4))
    readings[[3, 7], 0] = readings[[7, 3], 0]
    geometry = [SensorGeometry(model.name, model.pixels, 14.0) for model in models]
    found = calibrate_and_assess(
        points, readings, geometry, None, CalibrationSettings(labels="exclude")
    )
    fewer = calibrate_and_assess(points[10:], readings[10:], geometry, None, CalibrationSettings())
    held = CalibrationWithControlPoints(found, points, readings, None)
    before = CalibrationWithControlPoints(fewer, points[10:], readings[10:], None)
    return ReportContent(
        title=f"Calibration {EVIL}",
        calibration=found,
        names=[EVIL if row in (3, 5) else f"P{row + 1}" for row in range(40)],
        points_mm=points,
        readings_px=readings,
        provenance={"note": EVIL},
        compared=ComparedCalibration(EVIL, "before", compare(held, before)),
    )


@pytest.fixture(scope="module")
def written(content: ReportContent, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the report and its figures, which were drawn once for both."""
    folder = tmp_path_factory.mktemp("report")
    with pytest.MonkeyPatch.context() as patch:
        drawn: list[str] = []

        def counted(name: str, make: Callable[[ReportContent], Any], given: ReportContent) -> Any:
            drawn.append(name)
            return make(given)

        for name, make in FIGURES.items():
            patch.setitem(FIGURES, name, partial(counted, name, make))
        write_report(content, folder / "report.html", folder / "figures")
    assert sorted(drawn) == sorted(FIGURES)
    return folder


@pytest.fixture(scope="module")
def page(written: Path) -> str:
    return (written / "report.html").read_text("utf-8")


class Tags(HTMLParser):
    """All tags with their attributes, and the text between them."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def read(page: str) -> Tags:
    found = Tags()
    found.feed(page)
    assert found.open == []
    return found


@pytest.mark.slow
def test_nothing_is_loaded_from_elsewhere_and_no_script_runs(page: str):
    found = read(page)
    names = {tag for tag, _ in found.tags}
    assert not names & {"script", "link", "iframe", "object", "embed", "base", "form", "svg"}
    for tag, attributes in found.tags:
        assert not any(name.startswith("on") for name in attributes)
        for name in ("src", "href", "srcset", "action"):
            if name in attributes:
                assert tag == "img"
                assert str(attributes[name]).startswith("data:image/svg+xml;base64,")
    assert "url(" not in page
    assert "@import" not in page


@pytest.mark.slow
def test_every_figure_is_in_it(page: str):
    images = [attributes for tag, attributes in read(page).tags if tag == "img"]
    assert len(images) == len(FIGURES)
    for image in images:
        svg = base64.b64decode(str(image["src"]).partition(",")[2]).decode()
        assert "<svg" in svg
        assert "<script" not in svg
        # Namespaces only: nothing is fetched.
        assert not re.search(r'(xlink:href|href|src)="(?!#|data:)', svg)


def test_texts_from_outside_are_escaped(page: str):
    assert "<script>" not in page
    # The title twice, the note, a listed label and the previous calibration, as they were given.
    assert read(page).text.count(EVIL) >= 5


def test_it_says_what_the_calibration_found(content: ReportContent, page: str):
    text = read(page).text
    [finding] = content.calibration.labels
    assert (finding.kind, finding.sensor) == ("exchanged", "vertical")
    assert sorted(finding.points) == [4, 8]
    assert "exchanged" in text
    # The two readings left out are in no error: noise of 0.1 px is a few tenths of a millimetre.
    errors = content.fitted_errors_mm
    rms = float(np.sqrt((errors**2).sum(axis=1)[np.isfinite(errors).all(axis=1)].mean()))
    assert rms < 1.0
    assert f"{number(rms)} mm" in text
    used = int(np.isfinite(content.readings_px).sum()) - 2
    assert text.count(f"RMS over {used} readings") == 3
    assert len(content.calibration.cross_validation) == 2
    for check in content.calibration.cross_validation:
        assert check.errors is not None
        assert number(check.errors.max_absolute_mm[2]) in text
    assert content.calibration.diagnosis is not None
    for remark in content.calibration.diagnosis.remarks:
        assert remark in text
    median = np.nanmedian(np.linalg.norm(content.volume_uncertainty_mm, axis=1))
    assert f"{number(float(median))} mm" in text


def test_the_expected_deviation_is_that_of_new_points(content: ReportContent):
    generator = np.random.default_rng(9)
    assert content.volume_mm is not None
    points = generator.uniform(*content.volume_mm, (400, 3))
    readings = CameraStack.of(simulated_sensor_models()).project(points)
    readings += generator.normal(0, SIGMA_PX, readings.shape)
    sigma = measurement_sigma(content.calibration, readings)
    found = reconstruct(content.calibration.models, readings, sigma)
    errors = found.position_mm - points
    expected = content.uncertainty_mm(points)
    ratio = np.sqrt((errors**2).mean(axis=0) / (expected**2).mean(axis=0))
    # One calibration of forty points: its own error is one draw, the same for all points.
    assert (ratio > 0.6).all()
    assert (ratio < 1.5).all()


def test_a_calibration_from_no_measurement_has_a_report_too():
    empty = ReportContent("Nominal", nominal_calibration(), [], np.empty((0, 3)), np.empty((0, 4)))
    page = read(report_page(empty))
    assert "principal_distance_px" in page.text
    assert not [tag for tag, _ in page.tags if tag == "img"]


def test_lengths_of_a_wave_that_were_left_out_are_stated(content: ReportContent, page: str):
    assert "Lengths that were left out" not in page
    lengths = LengthErrors(poses=164, lengths=492, rms_mm=0.018, mean_mm=-0.002, max_mm=0.071)
    text = read(report_page(replace(content, lengths_left_out=lengths), {})).text
    assert "492 lengths at poses held out, RMS" in text
    told = text[text.index("Lengths that were left out") :]
    for value in ("164", "492", "0.018", "0.002", "0.071"):
        assert value in told[:300]


def test_pictures_are_written_beside_it(written: Path, page: str):
    assert page.startswith("<!doctype html>")
    found = list((written / "figures").iterdir())
    assert {file.stem for file in found} == set(FIGURES)
    for file in found:
        assert file.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_many_points_do_not_make_a_large_page(content: ReportContent):
    rows = np.random.default_rng(1).integers(0, 40, 4000)
    calibration = replace(
        content.calibration,
        residuals_px=tuple(content.calibration.residuals_px[row] for row in rows),
        cross_validation=(),
        labels=(),
    )
    many = ReportContent(
        "Many",
        calibration,
        [str(row) for row in rows],
        content.points_mm[rows],
        content.readings_px[rows],
    )
    drawn = draw("residuals-position", many, "svg")
    assert drawn is not None
    assert len(drawn) < 1_000_000


def test_figures_keep_their_size_on_a_small_screen(page: str):
    """Below the least width a figure is scrolled within its own box, not shrunk."""
    assert page.count('<figure><div class="scroll"><img ') == len(FIGURES)
    style = page.partition("<style>")[2].partition("</style>")[0]
    screen, _, printed = style.partition("@media print")
    assert re.search(r"figure img\{[^}]*min-width:40rem", screen)
    assert re.search(r"\.scroll\{overflow-x:auto\}", screen)
    assert re.search(r"figure img\{min-width:0\}", printed)


@pytest.mark.slow
def test_a_report_is_drawn_once(sqlite_client: Any, monkeypatch: pytest.MonkeyPatch):
    drawn: list[str] = []

    def page_of(content: ReportContent) -> str:
        drawn.append(content.title)
        return f"{content.title} {content.compared and content.compared.name}"

    def figure_of(name: str, content: ReportContent) -> bytes | None:
        drawn.append(name)
        return None if name == "coverage" else name.encode()

    monkeypatch.setattr(router, "render_page", page_of)
    monkeypatch.setattr(router, "render_figure", figure_of)
    example = NEW_CALIBRATIONS["frame"]["value"]
    sqlite_client.post("/api/v1/calibrations", json=example | {"id": "one"})
    sqlite_client.post("/api/v1/calibrations", json=example | {"id": "two"})
    url = "/api/v1/calibrations/one/report"

    def times(path: str, **query: str) -> int:
        drawn.clear()
        answers = [sqlite_client.get(url + path, params=query) for _ in range(2)]
        assert answers[0].content == answers[1].content
        return len(drawn)

    assert times(".html") == 1
    assert times(".html", previous_calibration_id="two") == 1
    assert times("/residuals-order.png") == 1
    assert times("/residuals-pixels.png") == 1
    assert times("/coverage.png") == 2  # a problem, which is not kept
    assert times(".html") == 0
    assert "sim-nominal" in sqlite_client.get(f"{url}.html").text
    # What the page says has changed: which one is active, and the device's title.
    sqlite_client.post("/api/v1/calibrations/two/activate")
    assert times(".html", previous_calibration_id="two") == 0
    assert "two" in sqlite_client.get(f"{url}.html").text
    sqlite_client.patch("/api/v1/devices/sim", json={"title": "Another title"})
    assert times(".html") == 1
    assert "Another title" in sqlite_client.get(f"{url}.html").text


def test_reports_are_kept_within_their_bound():
    kept = ReportCache(100)
    kept.keep("large", bytes(101))
    assert kept.get("large") is None
    for name in "abc":
        kept.keep(name, name.encode() * 33)
    assert kept.get("a") == b"a" * 33  # asked for: b is the oldest now
    kept.keep("d", b"d" * 33)
    assert [name for name in "abcd" if kept.get(name) is not None] == ["a", "c", "d"]
    kept.keep("d", b"e" * 34)
    assert [name for name in "acd" if kept.get(name) is not None] == ["a", "c", "d"]
    assert kept.get("d") == b"e" * 34


def test_the_route_names_the_figures_that_there_are():
    assert set(get_args(FigureName)) == set(FIGURES)


@pytest.mark.slow
def test_a_stored_calibration_has_its_report(sqlite_client: Any, monkeypatch: pytest.MonkeyPatch):
    body = NEW_CALIBRATIONS["frame"]["value"] | {"note": EVIL}
    assert sqlite_client.post("/api/v1/calibrations", json=body).status_code == 201
    answer = sqlite_client.get("/api/v1/calibrations/sim-frame/report.html")
    assert answer.headers["content-type"].startswith("text/html")
    text = read(answer.text).text
    assert EVIL in text
    # Never active itself, it is compared with what is, and that is what the page says.
    assert "Compared with the active calibration" in text
    assert "The other is sim-nominal, which is active now." in text
    found = sqlite_client.get("/api/v1/calibrations/sim-frame").json()
    assert found["content_hash"] in text
    # The page came from a process; for one figure more it takes as long to start as to draw.
    monkeypatch.setattr(router, "render_figure", lambda name, content: draw(name, content, "png"))
    figure = sqlite_client.get("/api/v1/calibrations/sim-frame/report/coverage.png")
    assert figure.content.startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("relation", "title", "sentence"),
    [
        ("before", "the calibration before", "which was active before this one"),
        ("active", "the active calibration", "which is active now"),
        ("chosen", "another calibration", "as asked for"),
    ],
)
def test_what_it_is_compared_with_is_said(
    content: ReportContent, relation: Any, title: str, sentence: str
):
    assert content.compared is not None
    other = replace(content, compared=replace(content.compared, name="it", relation=relation))
    text = read(report_page(other, {})).text
    assert f"Compared with {title}" in text
    assert f"The other is it, {sentence}." in text


@pytest.mark.slow
def test_which_calibration_a_stored_one_is_compared_with(sqlite_client: Any):
    example = NEW_CALIBRATIONS["frame"]["value"]
    for name in ("one", "two"):
        made = sqlite_client.post("/api/v1/calibrations", json=example | {"id": name})
        assert made.status_code == 201

    def compared(name: str, previous: str | None = None) -> tuple[str, str]:
        with sqlite_client.app.state.database.read() as session:
            found = assemble_report(session, name, previous).compared
        assert found is not None
        return found.name, found.relation

    assert compared("one") == ("sim-nominal", "active")
    sqlite_client.post("/api/v1/calibrations/one/activate")
    sqlite_client.post("/api/v1/calibrations/two/activate")
    assert compared("one") == ("sim-nominal", "before")
    assert compared("two") == ("one", "before")
    assert compared("sim-nominal") == ("two", "active")
    assert compared("two", "sim-nominal") == ("sim-nominal", "chosen")
