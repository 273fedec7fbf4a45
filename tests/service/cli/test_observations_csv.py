"""Control points from CSV files: read exactly, or refused with the place."""

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from service.cli.observations_csv import read_observations

NUMBER = st.floats(-1e6, 1e6, allow_nan=False)


@given(st.data(), st.integers(0, 6), st.booleans())
def test_round_trip(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, count: int, deviations: bool
) -> None:
    points = data.draw(st.lists(st.tuples(NUMBER, NUMBER, NUMBER), min_size=count, max_size=count))
    cell = st.one_of(st.none(), NUMBER)
    readings = data.draw(st.lists(st.tuples(cell, cell), min_size=count, max_size=count))
    path = tmp_path_factory.mktemp("csv") / "points.csv"
    header = ["name", "X_mm", "Y_mm", "Z_mm", "left_px", "right_px"]
    if deviations:
        header += ["right_sigma_px", "left_sigma_px"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for index, (point, reading) in enumerate(zip(points, readings, strict=True)):
            extra = [0.25, 0.5] if deviations else []
            writer.writerow([f"p{index}", *point, *reading, *extra])
    table = read_observations(path)
    assert table.sensors == ("left", "right")
    assert table.points_mm.tolist() == [list(point) for point in points]
    expected = np.array([[np.nan if v is None else v for v in row] for row in readings])
    assert np.array_equal(table.readings_px, expected.reshape(count, 2), equal_nan=True)
    if deviations:
        assert table.sigma_px is not None
        assert table.sigma_px.tolist() == [[0.5, 0.25]] * count
    else:
        assert table.sigma_px is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("X_mm,Y_mm,a_px\n1,2,3\n", "no column Z_mm"),
        ("X_mm,Y_mm,Z_mm\n1,2,3\n", "no column of readings"),
        ("", "columns are none"),
        ("X_mm,Y_mm,Z_mm,a_px\n1,2,3,4\n1,two,3,4\n", 'line 3: Y_mm is "two"'),
        ("X_mm,Y_mm,Z_mm,a_px\n1,,3,4\n", 'line 2: Y_mm is ""'),
        ("X_mm,Y_mm,Z_mm,a_px,b_px,a_sigma_px\n1,2,3,4,5,6\n", "no b_sigma_px; give all or none"),
        ("X_mm,Y_mm,Z_mm,a_px,b_px,a_px\n1,2,3,4,5,6\n", "give a_px; rename or delete one"),
        ("X_mm,Y_mm,Z_mm,a_px,X_m\n1,2,3,4,5\n", '"X_mm" .number 1. and "X_m" .number 5.'),
        ("X_mm,Y_mm,Z_mm,a_px,A [px],a [px]\n1,2,3,4,5,6\n", '"a_px" .number 4. and "a .px."'),
        ("name,X_mm,Y_mm,Z_mm,a_px,Name\np,1,2,3,4,q\n", "both give name"),
        ("X_mm,Y_mm,Z_mm,a_px,a_sigma_px,b_sigma_px\n1,2,3,4,5,6\n", "b_sigma_px but no b_px"),
    ],
)
def test_what_is_wrong_is_said_with_its_place(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "points.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InvalidParameter, match=message):
        read_observations(path)


@pytest.mark.parametrize(
    ("headings", "message"),
    [
        ("X_mm,Y_mm,Z_mm,a_px,b", 'column "b", which is called like the sensor a'),
        ("X_mm,Y_mm,Z_mm,cam1_px,Cam 12", "call it Cam 12_px if it has readings"),
        ("X_mm,Y_mm,Z_mm,left_px,LEFT", "like the sensor left but is not said to be in pixels"),
    ],
)
def test_read_observations_unused_column_like_a_sensor_is_refused(
    tmp_path: Path, headings: str, message: str
) -> None:
    path = tmp_path / "points.csv"
    path.write_text(f"{headings}\n1,2,3,4,5\n1,2,3,n/a,-\n", encoding="utf-8")
    with pytest.raises(InvalidParameter, match=message):
        read_observations(path)


@pytest.mark.parametrize(
    ("extra", "told"),
    [
        ("right", "the numbers in the column right are not used"),
        ("right,off [mm]", "the numbers in the columns right, off [mm] are not used"),
        ("pose,marker", "the numbers in the columns pose, marker are not used"),
    ],
)
def test_read_observations_unused_numbers_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], extra: str, told: str
) -> None:
    path = tmp_path / "points.csv"
    count = 1 + extra.count(",")
    rows = f"1,2,3,4{',5' * count},good\n1,2,3,4{',' * count},\n"
    path.write_text(f"X_mm,Y_mm,Z_mm,left_px,{extra},remark\n{rows}", encoding="utf-8")
    assert read_observations(path).sensors == ("left",)
    printed = capsys.readouterr()
    assert told in " ".join(printed.err.split())
    assert not printed.out


def test_read_observations_text_and_row_numbers_are_not_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "points.csv"
    path.write_text(",name,X_mm,Y_mm,Z_mm,left_px,remark,empty\n0,1,1,2,3,4,2 mm off,\n", "utf-8")
    read_observations(path)
    assert not capsys.readouterr().err


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InvalidParameter, match="cannot be read"):
        read_observations(tmp_path / "none.csv")
