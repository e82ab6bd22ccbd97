"""Sphinx configuration: `make docs`."""

project = "sb3-mpc-policy"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
myst_enable_extensions = ["dollarmath"]
html_theme = "furo"
exclude_patterns = ["_build"]
autodoc_typehints = "description"
