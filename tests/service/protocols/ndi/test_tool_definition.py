"""Which tool an uploaded definition means."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.protocols.ndi.port_handles import MAX_DEFINITION_BYTES, match_tool, names_in_definition

TOOLS = ("probe", "ref", "a-tool-with-a-rather-long-name")


def rom(part_number: str) -> bytes:
    """A definition file: 752 bytes, the part number where such files have it."""
    image = bytearray(752)
    image[:3] = b"NDI"
    image[580:592] = b"ref".ljust(12, b"\0")
    image[592:612] = part_number.encode().ljust(20, b"\0")
    return bytes(image)


@pytest.mark.parametrize(
    ("image", "tool"),
    [
        (rom("probe"), "probe"),
        (rom("PROBE "), "probe"),
        (rom("8700340"), "ref"),
        (rom("a-tool-with-a-rather-long-name"[:20]), TOOLS[2]),
        (rom("unheard-of"), None),
        (rom(""), None),
        (b"probe\n".ljust(1024, b"\0"), "probe"),
        (b"\0\1 8700340 \0", "ref"),
        (b"probe\0ref\0", None),
        (b"probes", None),
        (b"", None),
    ],
)
def test_the_tool_that_is_meant(image: bytes, tool: str | None):
    """The maker of a definition file is no name: only its part number counts."""
    assert match_tool(names_in_definition(image), TOOLS, {"8700340": "ref"}) == tool


def test_a_part_number_wins_over_a_name():
    assert match_tool(("probe",), TOOLS, {"Probe": "ref"}) == "ref"


@given(st.binary(max_size=MAX_DEFINITION_BYTES))
def test_no_upload_does_harm(image: bytes):
    assert len(names_in_definition(image)) <= 100
    assert match_tool(names_in_definition(image), TOOLS, {}) in (*TOOLS, None)
