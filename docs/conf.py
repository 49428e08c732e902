"""Configuration of the documentation: `sphinx-build -W --keep-going -b html docs docs/_build`."""

from __future__ import annotations

import sys
from pathlib import Path

import roadgym

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))

project = "roadgym"
version = release = roadgym.__version__
language = "en_GB"
nitpicky = True
smartquotes = False  # Y' is a derivative
exclude_patterns = ["_build", "_generated"]

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
extensions += ["commands", "docstrings", "gallery", "mathml", "ranges"]
myst_enable_extensions = ["deflist", "dollarmath"]
myst_heading_anchors = 3
myst_links_external_new_tab = True

html_theme = "furo"
html_title = "roadgym"
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["style.css"]
html_copy_source = False
html_show_sourcelink = False
html_show_copyright = False

default_role = "py:obj"
add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say what they take and give, with shapes and units
napoleon_use_rtype = False
napoleon_custom_sections = [("Attributes", "params_style")]  # one entry may describe several
nitpick_ignore_regex = [(r"py:.*", r"(gymnasium|numpy|stable_baselines3)\..*")]
