"""Sphinx settings for the site that ``make docs`` builds, offline, from the repository's pages."""

from __future__ import annotations

import sys
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

sys.path.insert(0, str(Path(__file__).parent))

import gallery
import plain_pages
import public_names

project = "physx"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
root_doc = "docs/index"
include_patterns = [
    "docs/**.md",
    "physx*/README.md",
    "examples/*/README.md",
    *(f"{name}.md" for name in ("README", "CHANGELOG", "CONTRIBUTING", "RELEASING", "SECURITY")),
]
exclude_patterns = ["docs/_build", ".venv", "sessions", "tests", "physx*/src"]
myst_heading_anchors = 4
default_role = "code"
nitpicky = False  # annotations name types of libraries whose pages are not included

toc_object_entries = False  # the sidebar of each page would take four fifths of the time

html_theme = "furo"
html_title = "physx"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_show_copyright = False
html_copy_source = False

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_class_signature = "separated"
napoleon_use_ivar = True


class FaceDirective(SphinxDirective):
    """``.. face:: MODULE``: a module's purpose, and the names that it is the first to offer."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return the description as nodes."""
        text = public_names.reference(self.arguments[0])
        return self.parse_text_to_nodes(text, allow_section_headings=True)


def escape(
    app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]
) -> None:
    """Escape the lines of a docstring."""
    lines[:] = map(public_names.escaped, lines)


def write_notebooks(app: Sphinx) -> None:
    """Write the gallery's scripts as notebooks, which its pages offer."""
    gallery.write_notebooks()


def write_plain_pages(app: Sphinx, error: Exception | None) -> None:
    """Write the pages as plain Markdown beside the site."""
    if error is None:
        plain_pages.write(Path(app.outdir))


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the directive."""
    app.connect("builder-inited", write_notebooks)
    app.connect("build-finished", write_plain_pages)
    app.add_directive("face", FaceDirective)
    app.connect("autodoc-process-docstring", escape)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
