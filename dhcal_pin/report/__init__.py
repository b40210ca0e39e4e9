"""Reports: HTML, Markdown and JSON documents of a result."""
