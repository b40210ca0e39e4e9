"""Sphinx configuration of the documentation.

    sphinx-build -W -b html docs docs/_build/html

Notebooks are shown without running them. Executed copies in `docs/_build/notebooks`, if there are any, are
shown with their outputs:

    jupyter nbconvert --to notebook --execute --output-dir docs/_build/notebooks notebooks/*.ipynb
"""

import os
import sys
from importlib import metadata
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

project = "dhcal_pin"
author = "The dhcal_pin developers"
copyright = "2026, the dhcal_pin developers"
release = metadata.version("dhcal-pin")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "api_pages",
    "cli_pages",
    "evidence_pages",
    "mathml",
    "plot_pictures",
    "schema_files",
    "tutorial_pages",
]
exclude_patterns = ["_build", "extensions"]
nitpicky = False

myst_enable_extensions = ["deflist", "dollarmath", "fieldlist"]
myst_heading_anchors = 3
nb_execution_mode = "off"

default_role = "py:obj"
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
# Names of types that would be shown as the long unions that they stand for.
autodoc_type_aliases = {"Array": "Array", "ArrayLike": "ArrayLike", "Fold": "tuple[Array, ...]"}
python_use_unqualified_type_names = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False

html_theme = "furo"
html_title = "dhcal_pin"
html_static_path = ["_static"]
html_css_files = ["custom.css"]
html_copy_source = False
html_show_sourcelink = False
# GitHub Actions state the address of the repository; pages of other builds have no link to their source.
if repository := os.environ.get("GITHUB_REPOSITORY"):
    html_theme_options = {
        "source_repository": f"{os.environ['GITHUB_SERVER_URL']}/{repository}/",
        "source_branch": "main",
        "source_directory": "docs/",
    }
copybutton_prompt_text = "$ "

# sphinx-build -b linkcheck: links to other sites, which .github/workflows/links.yml checks every week.
linkcheck_timeout = 20
linkcheck_retries = 3
