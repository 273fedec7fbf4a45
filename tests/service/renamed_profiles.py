"""Profiles of one's own for tests: built-in ones under another name."""

from importlib import resources

WINDOW = "coda-mpx30"
"""Behind coded windows: worked out in closed form."""
LENS = "thesis-5.9"
"""Behind lenses: calibrated from its traced optics in seconds."""


def renamed_profile(name: str, of: str = WINDOW) -> str:
    """Return the file of a built-in profile, renamed."""
    file = resources.files("compute.optics.profiles") / "devices" / f"{of}.toml"
    text = file.read_text("utf-8")
    assert f'name = "{of}"' in text
    return text.replace(f'name = "{of}"', f'name = "{name}"', 1)
