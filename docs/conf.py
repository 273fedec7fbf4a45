"""Sphinx configuration of the documentation site (`make docs`).

The reference pages of REST, stream, command line, client and settings are written from the code
before each build, into docs/reference/generated (ignored by git).
"""

import sys
from pathlib import Path

from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

from generators import write_reference  # noqa: E402

from service.version import package_version  # noqa: E402

project = "Lumiline"
author = "The Lumiline maintainers"
project_copyright = f"{author}. Apache License 2.0"
version = release = package_version()

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["examples", "generators"]
nitpicky = False

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_class_signature = "separated"
napoleon_google_docstring = True
napoleon_numpy_docstring = False

copybutton_exclude = ".linenos, .gp"

html_theme = "furo"
html_title = f"Lumiline {version}"
html_static_path: list[str] = []
# Nothing is loaded from another host: the site can be read without a network.
html_theme_options = {"top_of_page_buttons": []}


def setup(app: Sphinx) -> None:
    """Show diagrams (Mermaid) as their source: drawing them needs a script from the network."""
    app.add_lexer("mermaid", TextLexer)


write_reference(Path(__file__).parent / "reference" / "generated")
