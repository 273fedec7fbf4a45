"""The guide to profiles: its example is one, and it tells of every built-in profile."""

import re
from pathlib import Path

from compute.optics.profiles.deserialisation import KINDS
from compute.optics.profiles.profile_loader import parse_profile, profile_names

GUIDE = (Path(__file__).parents[4] / "docs" / "how-to" / "profiles.md").read_text("utf-8")


def test_the_example_is_a_profile() -> None:
    (example,) = re.findall(r"```toml\n(.*?)```", GUIDE, re.DOTALL)
    profile = parse_profile(example, "guide")
    assert [sensor.position_mm[0] for sensor in profile.sensors] == [-400.0, 0.0, 400.0]
    assert profile.rates.exposure_s == 1e-4


def test_every_built_in_profile_and_every_kind_is_in_a_table() -> None:
    assert tuple(sorted(re.findall(r"^\| `([a-z0-9.-]+)` \|", GUIDE, re.MULTILINE))) == (
        profile_names()
    )
    assert all(f"`{kind}`" in GUIDE for kind in KINDS.values())
