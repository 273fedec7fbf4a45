"""Whatever is wrong in a profile is refused by its dotted path."""

import copy
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.optics.profiles.deserialisation import build_profile
from compute.optics.profiles.profile_loader import load_profile, parse_profile, profile_names
from compute.optics.profiles.profile_sections import RetroMarkers

DEVICES = resources.files("compute.optics.profiles") / "devices"
TEXTS = {name: (DEVICES / f"{name}.toml").read_text("utf-8") for name in profile_names()}
BAR = TEXTS["bar"]

OPTIONAL = {"year", "notes", "published", "assumed", "distance", "note"}
DEFAULTED = {"z", "plate_thickness", "plate_index", "gray_bits", "analogue_bits", "length"}

RETRO = """
[markers]
kind = "retro"
illuminator_intensity = "2 W/sr"
illuminator_position = ["0 mm", "10 cm", "0 mm"]
wavelength = "880 nm"
spectral_width = "50 nm"
retroreflection = "500 cd/lx/m^2"
observation_half_angle = "0.4 deg"
half_angle = "30 deg"
diameter = "12 mm"
max_markers = 8
"""


def with_section(section: str, text: str) -> str:
    """The bar's profile with one of its tables replaced."""
    before, rest = BAR.split(f"[{section}]\n", 1)
    return before + text + "\n[" + rest.split("\n[", 1)[1]


def refused(text: str) -> InvalidParameter:
    with pytest.raises(InvalidParameter) as caught:
        parse_profile(text, origin="mine.toml")
    assert caught.value.detail.startswith("profile mine.toml")
    return caught.value


@pytest.mark.parametrize(
    ("old", "new", "field", "why"),
    [
        (
            'radius = "-16.54 mm"',
            'radius = "16.54"',
            "optics.main.elements[1].shapes[1].radius",
            '"16.54" has no unit; give a length such as "16.54 mm"',
        ),
        (
            'radius = "-16.54 mm"',
            "radius = -16.54",
            "optics.main.elements[1].shapes[1].radius",
            "-16.54 has no unit",
        ),
        ('pitch = "12 um"', 'pitch = "12 us"', "pixels.pitch", '"12 us" is no length'),
        ('pitch = "12 um"', 'pitch = "0 um"', "pixels.pitch", "it must be positive"),
        ('pitch = "12 um"', 'pitch = "12 um"\npich = 1', "pixels.pich", "there is no such field"),
        ('pitch = "12 um"', "", "pixels.pitch", "it is missing; give a length"),
        ("count = 2048", "count = 2048.5", "pixels.count", "2048.5 is not a whole number"),
        ("count = 2048", 'count = "2048"', "pixels.count", "is not a whole number"),
        ("count = 2048", "count = true", "pixels.count", "is not a whole number"),
        ("count = 2048", f"count = {10**400}", "pixels.count", "is not a whole number"),
        ("count = 2048", "count = 2000000", "pixels.count", "at most 1000000"),
        ("blooming = 0", f"blooming = {10**400}", "detector.blooming", "is not a number"),
        ("blooming = 0", "blooming = -inf", "detector.blooming", "-inf is not a number"),
        ("count = 2048", "count = 0", "pixels.count", "it must be positive"),
        ("bits = 12", "bits = 24", "detector.bits", "it must be 8 to 16"),
        (
            "quantum_efficiency = 0.5",
            "quantum_efficiency = 1.5",
            "detector.quantum_efficiency",
            "at most 1",
        ),
        (
            "quantum_efficiency = 0.5",
            "quantum_efficiency = nan",
            "detector.quantum_efficiency",
            "nan is not a number",
        ),
        ("blooming = 0", "blooming = 2", "detector.blooming", "0 to 1"),
        ('half_angle = "30 deg"', "half_angle = 0.5", "markers.half_angle", "give an angle"),
        ('half_angle = "30 deg"', 'half_angle = "95 deg"', "markers.half_angle", "90 deg"),
        (
            'radiant_intensity = "25 mW/sr"',
            'radiant_intensity = "25 mW"',
            "markers.radiant_intensity",
            "is no radiant intensity",
        ),
        ('"strobed"', '"flashed"', "markers.illumination", '"strobed", "simultaneous"'),
        ('kind = "led"', 'kind = "lamp"', "markers.kind", 'not one of "led", "retro"'),
        ('kind = "led"', "", "markers.kind", "it is missing"),
        ('kind = "stop"', 'kind = "mirror"', "optics.main.elements[0].kind", '"lens", "stop"'),
        ("indices = [1.52]", "indices = [0.5]", "optics.main.elements[1].indices", "1 to 10"),
        ("indices = [1.52]", "indices = 1.52", "optics.main.elements[1].indices", "not a list"),
        (
            'thicknesses = ["4 mm"]',
            'thicknesses = ["1 mm"]',
            "optics.main.elements[1].thicknesses",
            "at least",
        ),
        ('sensor_z = "35.58 mm"', 'sensor_z = "1 mm"', "optics.main.sensor_z", "behind the last"),
        ('exposure = "100 us"', 'exposure = "2 ms"', "rates.exposure", "at most 0.001"),
        ('size = ["600 mm", ', "size = [", "volume.size", "it has 2 items; it must have 3"),
        ('size = ["600 mm", ', 'size = ["-1 mm", ', "volume.size", "positive"),
        ('size = ["600 mm", ', 'size = ["600", ', "volume.size[0]", "has no unit"),
        ('name = "horizontal"', 'name = "vertical"', "sensors", "two named vertical"),
        (
            'optics = "main"',
            'optics = "other"',
            "sensors",
            "use the optics other; the profile has main",
        ),
        (
            "measured_direction = [0, 1, 0]",
            "measured_direction = [0, 0, 0]",
            "sensors[0].measured_direction",
            "must not be zero",
        ),
        (
            'aim = ["0 mm", "0 mm", "1500 mm"]',
            'aim = ["250 mm", "-86 mm", "0 mm"]',
            "sensors[0].aim",
            "the sensor's own position",
        ),
        ('name = "bar"', 'name = " "', "name", "is not text that is not empty"),
        ('"rates" = "as', '"rate" = "as', 'assumed."rate"', "no such field"),
        ('"detector" = "as', '"detector.bit" = "as', 'assumed."detector.bit"', "no such field"),
        (
            '"optics.main.elements[0]" =',
            '"optics.main.elements[2]" =',
            'assumed."optics.main.elements[2]"',
            "no such field",
        ),
        ('"detector" = "as', '".detector" = "as', 'assumed.".detector"', "no such field"),
        (
            '"detector" = "as the simulated device has it; a good line sensor"',
            '"detector" = ""',
            "assumed.detector",
            "is not text",
        ),
    ],
)
def test_refusals(old: str, new: str, field: str, why: str) -> None:
    assert old in BAR
    error = refused(BAR.replace(old, new, 1))
    assert error.context["field"] == field
    assert len(error.context["problems"]) == 1
    assert field in error.detail
    assert why in error.detail


@pytest.mark.parametrize(
    ("half_angle", "why"), [("60.1 deg", "below pi/3 (60 deg)"), ("95 deg", "90 deg")]
)
def test_a_flat_marker_is_halved_below_60_degrees(half_angle: str, why: str) -> None:
    """Its cosine alone does that at 60 deg; no sheet has a half angle beyond."""
    text = RETRO.replace('half_angle = "30 deg"', f'half_angle = "{half_angle}"')
    error = refused(with_section("markers", text))
    assert error.context["field"] == "markers.half_angle"
    assert why in error.detail


def test_everything_that_is_wrong_is_named_at_once() -> None:
    text = BAR.replace('pitch = "12 um"', "pitch = 12").replace("bits = 12", 'bits = "x"')
    error = refused(text.replace('line_rate = "1 kHz"', 'rate = "1 kHz"'))
    fields = {problem.split(":")[0] for problem in error.context["problems"]}
    assert fields == {"pixels.pitch", "detector.bits", "rates.rate", "rates.line_rate"}


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("name = ", "is not TOML: Invalid value"),
        ("a = " + 5_000 * "[", "nested too deeply"),
        ("a = " + 5_000 * "{a = ", "nested too deeply"),
        ("a = " + 5_000 * "9", "an integer has too many digits"),
        ("\n\na" + 30_000 * ".a" + " = 1", "dots, but for those of numbers (at line 3)"),
        ("1" + 30_000 * ".1" + " = 1", "more than 32 dots"),
        ('"a"' + 10_000 * ' . "a"' + " = 1", "more than 32 dots"),
        ("[a" + 30_000 * ".a" + "]", "more than 32 dots"),
    ],
)
def test_what_is_no_toml_is_refused(text: str, why: str) -> None:
    assert why in refused(text).detail


def test_dots_of_numbers_and_texts_are_taken() -> None:
    numbers = ", ".join(["0.125"] * 1_000)
    assert "dots" not in refused(f"a = [{numbers}]\nb = 'e.g. on p. 5 f.'").detail


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('pitch = "12 um"', "pitch = 0x" + 5_000 * "f"),
        ("bits = 12", "bits = 0x" + 5_000 * "f"),
        ('pitch = "12 um"', f'pitch = "{5_000 * "1"} um"'),
        ('pitch = "12 um"', f'pitch = "1{60_000 * " "}?"'),
    ],
)
def test_number_of_thousands_of_digits_is_refused(old: str, new: str) -> None:
    assert old in BAR
    field = new.partition(" ")[0]
    assert refused(BAR.replace(old, new)).context["field"].endswith(f".{field}")


def test_index_of_thousands_of_digits_is_refused_in_what_is_assumed() -> None:
    path = f"sensors[{5_000 * '9'}].name"
    text = BAR.replace("[assumed]\n", f'[assumed]\n"{path}" = "x"\n')
    assert f'assumed."{path}": the profile has no such field' in refused(text).detail


def test_a_plate_needs_a_detector_behind_each_track() -> None:
    error = refused(TEXTS["mitchelson-1971"].replace("gray_bits = 8", "gray_bits = 9"))
    assert error.context["field"] == "pixels"
    assert "has 12 tracks" in error.detail


@pytest.mark.parametrize(
    ("code", "field"),
    [
        ("{maximal_length_order = 40}", "optics.main.code.maximal_length_order"),
        ("{order = 9}", "optics.main.code.order"),
        ("[0, 2]", "optics.main.code"),
        ("[0, 0.5]", "optics.main.code[1]"),
    ],
)
def test_codes_of_a_window_are_refused(code: str, field: str) -> None:
    text = TEXTS["coda-mpx30"].replace("{maximal_length_order = 9}", code)
    assert refused(text).context["field"] == field


def test_a_code_may_be_written_bar_by_bar() -> None:
    text = TEXTS["coda-mpx30"].replace("{maximal_length_order = 9}", "[1, 0, 1, 1]")
    (window,) = parse_profile(text, "x").optics.values()
    assert window.code == (1, 0, 1, 1)


def test_retroreflecting_markers() -> None:
    markers = parse_profile(with_section("markers", RETRO), "x").markers
    assert isinstance(markers, RetroMarkers)
    assert markers.illuminator_position_mm == (0.0, 100.0, 0.0)
    assert markers.retroreflection_per_sr == 500.0
    assert markers.illumination == "simultaneous"
    error = refused(with_section("markers", RETRO.replace("500 cd/lx/m^2", "500")))
    assert error.context["field"] == "markers.retroreflection"


# --- any field of any built-in profile ------------------------------------------------------

Path_ = tuple[str | int, ...]


def walk(node: Any, path: Path_ = ()) -> Iterator[tuple[Path_, Any]]:
    items = node.items() if isinstance(node, dict) else enumerate(node)
    for key, value in items:
        yield (*path, key), value
        if isinstance(value, dict | list):
            yield from walk(value, (*path, key))


def dotted(path: Path_) -> str:
    steps = [f"[{step}]" if isinstance(step, int) else f".{step}" for step in path]
    return "".join(steps).removeprefix(".")


def at(document: Any, path: Path_) -> Any:
    for step in path:
        document = document[step]
    return document


DOCUMENTS = {name: tomllib.loads(text) for name, text in TEXTS.items()}
NODES = [
    (name, path, value)
    for name, document in DOCUMENTS.items()
    for path, value in walk(document)
    if path[0] not in ("assumed", "notes", "sources")
]
KEYS = [node for node in NODES if isinstance(node[1][-1], str)]
TABLES = [node for node in NODES if isinstance(node[2], dict) and node[1] != ("optics",)]
WITH_UNIT = [
    node
    for node in NODES
    if isinstance(node[2], str) and re.fullmatch(r"-?[0-9.]+ [a-zA-Z/]+", node[2])
]


def problems(document: Any) -> list[str]:
    profile, found = build_profile(document)
    assert (profile is None) == bool(found)
    return [problem.path for problem in found]


@pytest.mark.parametrize("name", DOCUMENTS)
def test_the_documents_have_no_problem_before(name: str) -> None:
    assert problems(DOCUMENTS[name]) == []


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(KEYS))
def test_any_missing_field_is_refused_by_its_path(node: tuple[str, Path_, Any]) -> None:
    name, path, _ = node
    document = copy.deepcopy(DOCUMENTS[name])
    del at(document, path[:-1])[path[-1]]
    found = problems(document)
    if path[-1] in OPTIONAL or path[0] == "error_sources":
        assert found == []
    elif path[:-1] == ("optics",):  # its name is the sensors' to know
        assert found == ["sensors"]
    elif path[-1] in DEFAULTED:  # the default may or may not suit the rest
        assert all(one.startswith(dotted(path[:2])) or one == "pixels" for one in found)
    elif path[-1] == "height" and "aperture" in path:  # open across, which a lens cannot be
        assert found in ([], [dotted(path[:-2])])
    elif path[-1] == "height" and path[0] == "optics":  # bars of any length
        assert found == []
    else:
        assert found == [dotted(path)]


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(TABLES), st.sampled_from(["extra", "radius_mm", "Name"]))
def test_any_unknown_field_is_refused_by_its_path(node: tuple[str, Path_, Any], key: str) -> None:
    name, path, _ = node
    document = copy.deepcopy(DOCUMENTS[name])
    at(document, path)[key] = "1 mm"
    assert problems(document) == [dotted((*path, key))]


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(WITH_UNIT), st.sampled_from(["number", "text", "unit", "list"]))
def test_any_quantity_without_its_unit_is_refused_by_its_path(
    node: tuple[str, Path_, Any], how: str
) -> None:
    name, path, value = node
    document = copy.deepcopy(DOCUMENTS[name])
    number = value.split()[0]
    wrong = {"number": float(number), "text": number, "unit": f"{number} Hz^2", "list": [value]}
    at(document, path[:-1])[path[-1]] = wrong[how]
    assert problems(document) == [dotted(path)]


def test_many_quantities_were_found() -> None:
    assert len(WITH_UNIT) > 300
    assert {path[0] for _, path, _ in WITH_UNIT} == {
        "sensors", "optics", "pixels", "detector", "markers", "rates", "volume", "published",
        "error_sources",
    }  # fmt: skip


# --- reading --------------------------------------------------------------------------------


def test_ones_own_profile_is_read_by_its_path(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(BAR, "utf-8")
    assert load_profile(file) == load_profile(str(file)) == load_profile("bar")


def test_a_profile_that_is_not_there_is_refused_with_the_names_that_are(tmp_path: Path) -> None:
    for missing in ("optotrack", str(tmp_path), "", "\0"):
        with pytest.raises(InvalidParameter, match=r"coda-mpx30.*optotrak"):
            load_profile(missing)


def test_a_file_that_is_not_text_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InvalidParameter, match="cannot be read"):
        load_profile(file)


@pytest.mark.slow
def test_pint_is_imported_when_a_profile_is_loaded_and_not_before() -> None:
    code = (
        "import sys; "
        "from compute.optics.profiles.profile_loader import load_profile, profile_names; "
        "profile_names(); before = 'pint' in sys.modules; load_profile('bar'); "
        "print(before, 'pint' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True"]
