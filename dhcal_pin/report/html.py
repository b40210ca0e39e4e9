"""HTML rendering of documents: pages with figures and scenes that need no network, and certificates.

`page/report.html` and `page/certificate.html` are the Jinja templates; style sheets and scripts are beside
them. All texts are escaped when they are inserted; only figures, style and scripts are inserted unchanged.
"""

from __future__ import annotations

import os

from .. import formatting
from .._typing import PathLike
from ..plots import svg_panels
from .document import Document, Panel


def is_html(path: PathLike) -> bool:
    """Return whether a path has the ending of an HTML file."""
    return os.fspath(path).lower().endswith((".html", ".htm"))


def html_page(document: Document) -> str:
    """Render a document as a page that contains everything it shows: style, scripts, figures and data."""
    shown = []
    for section in document.sections:
        groups = section.figures() if section.figures else ()
        if section.sentences or section.items or section.tables or groups:
            shown.append((section, groups))
    data = formatting.json_for_html(document.samples()) if document.samples else ""
    template = formatting.html_templates().get_template("report/page/report.html")
    with svg_panels() as svg:

        def draw(panel: Panel) -> str:
            return svg.draw(panel.plot, panel.key, panel.caption, panel.description, panel.size)

        return template.render(page=document, sections=shown, draw=draw, data=data)


def html_certificate(document: Document) -> str:
    """Render a document as a certificate: one or two printed pages without figures."""
    return formatting.html_templates().get_template("report/page/certificate.html").render(page=document)
