"""Pages of the notebooks: copies of `notebooks/`, or of the executed notebooks of the last run."""

from __future__ import annotations

import posixpath
import re
import shutil
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx


def copy_notebooks(app: Sphinx) -> None:
    """Copy the notebooks to the folder of the tutorials."""
    source = Path(app.srcdir)
    for notebook in sorted((source.parent / "notebooks").glob("*.ipynb")):
        executed = source / "_build" / "notebooks" / notebook.name
        is_current = executed.exists() and executed.stat().st_mtime > notebook.stat().st_mtime
        shutil.copyfile(executed if is_current else notebook, source / "tutorials" / notebook.name)


def link_pages(app: Sphinx, name: str, source: list[str]) -> None:
    """Replace links to notebooks by links to their pages, in the text of a page."""
    folder = posixpath.dirname(name)
    notebooks = posixpath.relpath("../notebooks", folder or ".")
    pages = posixpath.relpath("tutorials", folder or ".")
    source[0] = re.sub(rf"\]\({re.escape(notebooks)}/(\w+\.ipynb)", rf"]({pages}/\1", source[0])


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension."""
    app.connect("builder-inited", copy_notebooks)
    app.connect("source-read", link_pages)
    return {"parallel_read_safe": True}
