import pytest

from validation.interpolators.case import METHODS, compare_maps, errors_table, findings
from validation.interpolators.picture import draw

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def found():
    """Two grids and two noises of the case's six and three."""
    return compare_maps(((2, 2, 1), (5, 5, 3)), (0.015, 0.1), 80)


def one(found, nodes, noise):
    return next(c for c in found[0] if (c.nodes, c.noise_px) == (nodes, noise))


def test_a_finer_grid_leaves_less(found):
    for method in METHODS:
        for noise in (0.015, 0.1):
            fine, coarse = (one(found, nodes, noise).rms_px[method] for nodes in (144, 18))
            assert fine < 0.5 * coarse < found[1]


def test_the_penalised_spline_averages_what_interpolation_keeps(found):
    for noise in (0.015, 0.1):
        errors = one(found, 144, noise).rms_px
        assert errors["b-spline"] < 0.9 * min(errors["trilinear"], errors["tricubic"])
        assert errors["b-spline"] < noise


def test_interpolation_keeps_the_noise_of_the_nodes(found):
    """Cubics weigh the nodes so that three quarters or more of their noise is left between."""
    assert 0.06 < one(found, 144, 0.1).rms_px["tricubic"] < 0.12


def test_the_table_and_what_it_shows(found):
    table = errors_table(found[0])
    assert len(table.rows) == 4
    assert table.column("least")[-1] == "b-spline"
    words = " ".join(findings(*found))
    assert f"{found[1]:.3g} px RMS" in words
    assert "default" in words


def test_the_picture_is_a_png(found, tmp_path, monkeypatch):
    monkeypatch.setattr("validation.interpolators.picture.all_comparisons", lambda: found)
    monkeypatch.setattr("validation.interpolators.picture.NOISES_PX", (0.015, 0.1))
    draw(tmp_path / "maps.png")
    assert (tmp_path / "maps.png").read_bytes().startswith(b"\x89PNG")
