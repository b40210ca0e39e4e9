"""Pages in a real browser: what is seen on them, what they complain about, what they ask for."""

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

CHROMIUM = shutil.which("chromium")
# The checker of accessibility, as the package ships it.
AXE = resources.files("axe_playwright_python").joinpath("axe.min.js").read_text(encoding="utf-8")
# Software rendering, which works without a graphics card and in a container. Smooth edges, and pages that are
# drawn and put together like scenes, would take most of the time.
ARGUMENTS = (
    "--no-sandbox --disable-dev-shm-usage --use-gl=angle --use-angle=swiftshader "
    "--enable-unsafe-swiftshader --hide-scrollbars --webgl-antialiasing-mode=none "
    "--disable-gpu-rasterization --disable-gpu-compositing"
).split()
# What the driver, not the page, says when it copies a picture of a scene into the page.
COPIED = "GPU stall due to ReadPixels"
VIEWPORT = {"width": 700, "height": 400}
SLIDE = "it.value = it.max; it.dispatchEvent(new Event('input'))"
CLICK = "it.click()"
READY = "window.dhcal && window.dhcal.ready === true"
# Ten frames per second are enough, and without a graphics card each one takes processor time. For the same
# reason a bar without a value does not move.
FEW_FRAMES = """requestAnimationFrame = draw => setTimeout(() => draw(performance.now()), 100);
cancelAnimationFrame = clearTimeout;
const still = new CSSStyleSheet();
still.replaceSync("progress { appearance: none }");
document.adoptedStyleSheets.push(still);"""

# Draws the scene now and looks at its pixels: how many have each layer's colour, and a fingerprint.
LOOK = """() => {
  const { viewer } = dhcal, gl = viewer.renderer.getContext();
  viewer.render();
  const { drawingBufferWidth: width, drawingBufferHeight: height } = gl;
  const data = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
  const names = ["nominal", "calibrated", "frames", "points", "ellipsoids", "arrows", "black", "print"];
  const seen = Object.fromEntries(names.map(name => [name, 0]));
  const is = (i, ...color) => color.every((value, k) => Math.abs(data[i + k] - value) < 4);
  for (let i = 0; i < data.length; i += 4) {
    const r = data[i], g = data[i + 1], b = data[i + 2];
    if (b - r > 40 && g > r && r > 40 && !is(i, 86, 180, 233)) seen.nominal++;
    if (r - b > 70 && g - b > 35 && g > 0.55 * r) seen.calibrated++;
    const green = g - r > 45 && g - b > 8;   // both ellipsoids and y axes
    if (is(i, 213, 94, 0) || is(i, 86, 180, 233) || green) seen.frames++;
    if (green) seen.ellipsoids++;
    if (r < 40 && g < 55 && b > 45 && b < 90) seen.points++;
    if (r - g > 45 && b - g > 25) seen.arrows++;
    // Without smooth edges, single pixels of an edge may be black.
    if (r + g + b < 30 && data[i - 4] + data[i - 3] + data[i - 2] < 30) seen.black++;
    seen.print = (Math.imul(seen.print, 31) + r + 7 * g + 49 * b) | 0;
  }
  return seen;
}"""


@dataclass(frozen=True)
class Window:
    """One page of the browser and everything it complained about or asked for."""

    page: Any
    complaints: list[str]
    requests: list[str]

    def open(self, path: Path, html: str) -> None:
        """Loads a page from disk and waits until it says that it is ready."""
        path.write_text(html, encoding="utf-8")
        self.page.goto(path.as_uri())
        self.page.wait_for_function(READY)

    def check(self) -> None:
        """That the page was silent and asked no host for anything since the last check."""
        complaints, requests = self.complaints[:], self.requests[:]
        self.complaints.clear()
        self.requests.clear()
        assert not complaints
        assert all(url.startswith(("file:", "data:", "about:")) for url in requests), requests

    def look(self, name: str = "", *values: Any) -> dict[str, int]:
        """What is seen, after a call of the page if there is one: together they draw only once."""
        call = f"([name, values]) => {{ if (name) dhcal[name](...values); return ({LOOK})(); }}"
        return self.page.evaluate(call, [name, list(values)])

    def touch(self, control: Any, action: str) -> dict[str, int]:
        """What is seen after a control, `it`, was used."""
        return control.evaluate(f"it => {{ {action}; return ({LOOK})(); }}")

    def tip(self, arm: str) -> np.ndarray:
        """Where the page says an arm's tool is, (4, 4)."""
        return np.array(self.page.evaluate("arm => dhcal.tip(arm)", arm))

    def call(self, name: str, *values: Any) -> None:
        """A function of the page."""
        self.page.evaluate("([name, values]) => dhcal[name](...values)", [name, list(values)])


@dataclass(frozen=True)
class Browser:
    """Browser whose pages draw few frames."""

    process: Any

    def new_context(self, **options: Any) -> Any:
        """Return a context with the options of Playwright."""
        context = self.process.new_context(**options)
        context.add_init_script(FEW_FRAMES)
        return context

    def new_page(self, **options: Any) -> Any:
        """Return a page in a context of its own, which is closed with it."""
        page = self.process.new_page(**options)
        page.add_init_script(FEW_FRAMES)
        return page


def listen(source: Any, complaints: list[str]) -> None:
    """Collect what a page, or the pages of a context, write to the console."""
    source.on("console", lambda message: COPIED in message.text or complaints.append(message.text))


@contextmanager
def window_of(browser: Browser) -> Iterator[Window]:
    """A page that must stay silent and ask no host for anything."""
    page = browser.new_page(viewport=VIEWPORT)
    out = Window(page, [], [])
    listen(page, out.complaints)
    page.on("pageerror", lambda error: out.complaints.append(str(error)))
    page.on("request", lambda request: out.requests.append(request.url))
    yield out
    page.close()
    out.check()


# In MeshCat's own page: where a body of an arm stands, in columns, once its tool frame is there.
LIVE_FIND = """(arm, body) => {
  const node = viewer.scene_tree.find(["meshcat", arm, String(body)]).object;
  if (!node || !node.children.length) return null;
  viewer.scene_tree.object.updateMatrixWorld(true);
  const world = viewer.scene_tree.find(["meshcat"]).object.matrixWorld.clone().invert();
  return world.multiply(node.matrixWorld).elements;
}"""


def wait_for(page: Any, expression: str) -> None:
    """Wait until an expression of the page is true; the page forbids what Playwright's own function does.

    A frame that is being loaded cannot evaluate anything yet.
    """
    from playwright.sync_api import Error  # lazy import: only where a browser is

    for _ in range(600):
        with suppress(Error):
            if page.evaluate(expression):
                return
        time.sleep(0.1)
    raise AssertionError(f"not true within a minute: {expression}")
