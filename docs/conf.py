"""Sphinx configuration: `make docs`."""

from __future__ import annotations

import importlib
import inspect
import re

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

project = "sb3-mpc-policy"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
myst_enable_extensions = ["dollarmath"]
# Links such as how_it_works.md#how-fast, as GitHub has them.
myst_heading_anchors = 3
html_theme = "furo"
exclude_patterns = ["_build"]
autodoc_typehints = "description"


class MarkdownDocstring(SphinxDirective):
    """``{markdown-docstring} module:Class``: a docstring in Markdown, as those of Gymnasium's environments are.

    What comes after its first ``:param`` is left to autodoc.
    """

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        module, name = self.arguments[0].split(":")
        text = inspect.getdoc(getattr(importlib.import_module(module), name)) or ""
        # in bold in place of headings: the page has its own
        text = re.sub(r"^## (.*)$", r"**\1**", text.partition("\n:param")[0], flags=re.MULTILINE)
        return self.parse_text_to_nodes(re.sub(r":\w+:`~?(?:\w+\.)*(\w+)`", r"`\1`", text))


def keep_fields_of_markdown(_: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Of a docstring in Markdown autodoc, which reads reStructuredText, gets the arguments alone."""
    if what != "class" or "## Description" not in lines:
        return
    first = next(i for i, line in enumerate(lines) if line.startswith(":param"))
    last = next(i for i, line in enumerate(lines) if i > first and line.startswith("## "))
    lines[:] = lines[first:last]


def setup(app: Sphinx) -> None:
    app.add_directive("markdown-docstring", MarkdownDocstring)
    app.connect("autodoc-process-docstring", keep_fields_of_markdown)
