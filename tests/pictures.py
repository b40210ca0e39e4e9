"""Pictures of the README and the documentation, from `dhcal demo`: scene.png and report.png in notebooks.

    python tests/pictures.py [FOLDER]

FOLDER is notebooks by default. The pages are shown by `chromium`.
"""

import sys
import tempfile
from pathlib import Path

from pages import ARGUMENTS, CHROMIUM, READY
from playwright.sync_api import sync_playwright
from robots import ROOT

from dhcal_pin.cli import main

# Width and height of the pictures, and what is true when the page is drawn.
PICTURES = {"scene": (1100, 761, READY), "report": (1200, 1250, "document.readyState === 'complete'")}


def draw(folder: Path) -> None:
    """Run the demo and photograph its pages."""
    with tempfile.TemporaryDirectory() as demo, sync_playwright() as playwright:
        main.main(["demo", "--out", demo, "--quiet"])
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        for name, (width, height, is_drawn) in PICTURES.items():
            page = browser.new_page(viewport={"width": width, "height": height})
            page.goto(Path(demo, f"{name}.html").as_uri())
            page.wait_for_function(is_drawn, timeout=60_000)
            page.screenshot(path=folder / f"{name}.png")
        browser.close()


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "notebooks")
