"""Markdown rendering of documents, without figures and bars."""

from __future__ import annotations

from ..formatting import escape_markdown, markdown_table
from .document import Document, Section


def markdown(document: Document) -> str:
    """Render a document as Markdown."""
    parts = [
        f"# {escape_markdown(document.title)}",
        f"**Verdict: {document.status}**",
        *map(escape_markdown, document.reasons),
        f"**{escape_markdown(document.headline)}**",
        *map(escape_markdown, (*document.remarks, *document.warnings)),
    ]
    for section in document.sections:
        if blocks := _blocks(section):
            parts += [f"## {section.title}", *blocks]
    return "\n\n".join(parts) + "\n"


def _blocks(section: Section) -> list[str]:
    """Return the paragraphs, the list and the tables of a section."""
    blocks = [*map(escape_markdown, section.sentences)]
    if section.items:
        blocks.append("\n".join(f"- {escape_markdown(item)}" for item in section.items))
    for table in section.tables:
        blocks += [f"**{escape_markdown(table.caption)}**"] if table.caption else []
        blocks.append(markdown_table(table))
    return blocks
