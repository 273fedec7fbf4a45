"""Sensors behind windows, for the tests of masks."""

from compute.optics.sensor_placement import PlacedSensor, place_sensor


def sensor_behind(gap_mm: float, *, pitch_um: float = 10.0, pixels: int = 2048) -> PlacedSensor:
    """Return a sensor in the world's origin that looks along z and measures along x."""
    return place_sensor(
        "one",
        lens_position_mm=(0.0, 0.0, 0.0),
        aim_mm=(0.0, 0.0, 1000.0),
        measured_direction=(1.0, 0.0, 0.0),
        principal_distance_mm=gap_mm,
        pixels=pixels,
        pitch_um=pitch_um,
    )
