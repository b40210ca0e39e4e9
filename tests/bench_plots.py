"""Time of every plot of a result with 100,000 samples, relative to a named reference; run it as a script.

    python tests/bench_plots.py [--report]

The reference draws the same number of points as one line with matplotlib and its own Agg renderer: what any
plot of so many samples costs at least. A first plot of a result also computes what it shows, such as the
cross-validated errors; a second one finds it computed. Each plot is drawn into an image, on a result of its
own. `--report` measures how soon the report of 1,500 samples answers in Chromium.
"""

import io
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pages import ARGUMENTS, CHROMIUM
from robots import nominal_arm, paper

from dhcal_pin.calibration import Result, calibrate, split
from dhcal_pin.measurements import Noise, Pose
from dhcal_pin.report import write_report
from dhcal_pin.robot import Chain

N_SAMPLES = 100_000
# Longest time of a plot [s].
LIMIT = 2.0
PLOTS: dict[str, Callable[[Result], Any]] = {
    "plot_accuracy()": lambda fit: fit.plot_accuracy(),
    "plot_residuals()": lambda fit: fit.plot_residuals(),
    "plot_residuals(over='histogram')": lambda fit: fit.plot_residuals(over="histogram"),
    "plot_residuals(over=joint)": lambda fit: fit.plot_residuals(over=fit.chain.joint_names[1]),
    "plot_joint_corrections()": lambda fit: fit.plot_joint_corrections()[0],
    "plot_parameters()": lambda fit: fit.plot_parameters(),
    "plot_singular_values()": lambda fit: fit.plot_singular_values(),
    "plot_correlation()": lambda fit: fit.plot_correlation(),
    "plot_workspace()": lambda fit: fit.plot_workspace(),
}


def rendered(figure: Any) -> None:
    """Draw a figure into an image."""
    figure.savefig(io.BytesIO(), format="png")


def reference() -> None:
    """Draw a line through as many points as there are samples."""
    from matplotlib.figure import Figure

    figure = Figure()
    figure.subplots().plot(np.random.default_rng(0).standard_normal(N_SAMPLES))
    rendered(figure)


def seconds(work: Callable[[], object]) -> float:
    """Return the CPU time of a call [s]."""
    start = time.process_time()
    work()
    return time.process_time() - start


def fresh(fit: Result) -> Result:
    """Return a result that has computed nothing yet beside the solution."""
    return replace(fit)


def times(draw: Callable[[Result], Any], fit: Result) -> list[float]:
    """Return the CPU times of a first and of a second plot of a result [s]."""
    return [seconds(lambda: rendered(draw(fit).figure)) for _ in range(2)]


def plot_table() -> bool:
    """Print the times of all plots; return whether all of them keep the limit."""
    rng = np.random.default_rng(0)
    arm, actual = (Chain.from_dh(paper(name)) for name in ("sim_6dof", "sim_6dof_actual"))
    data = Pose.simulate(actual, rng.uniform(-1.5, 1.5, (N_SAMPLES, 6)), Noise(1e-4, 1e-4), rng)
    fit = calibrate(arm, data, "dh", extend="none")
    with_curves = calibrate(arm, data, "dh", free=["joint_1.sin1", "joint_1.cos1"], extend="none")
    reference()
    base = seconds(reference)
    print(f"reference (one line of {N_SAMPLES} points): {base:.3f} s")
    print(f"{'plot':34} {'first, s':>9} {'ratio':>7} {'second, s':>10} {'ratio':>7}")
    is_kept = True
    for name, draw in PLOTS.items():
        # The other plots do not depend on the harmonics, and only a fit with harmonics has curves.
        first, second = times(draw, fresh(with_curves if "corrections" in name else fit))
        is_kept &= first <= LIMIT
        print(f"{name:34} {first:9.2f} {first / base:7.1f} {second:10.2f} {second / base:7.1f}")
    return is_kept


def report_table() -> None:
    """Print size of the report of 1,500 samples, and the time until its list and its plots answer."""
    from playwright.sync_api import sync_playwright

    robot = nominal_arm("ur10")
    rng = np.random.default_rng(0)
    data = Pose.simulate(robot, rng.uniform(-3, 3, (1500, 6)), Noise(1e-4, 1e-4), rng)
    fitted, held_out = split([data], 0.3, 0)
    fit = calibrate(robot, fitted, "minimal,base,tool", holdout=held_out, extend="none")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        path = Path(folder) / "report.html"
        print(
            f"report of 1500 samples: written in {seconds(lambda: write_report(fit, path)):.2f} s, ", end=""
        )
        print(f"{path.stat().st_size / 1e6:.2f} MB")
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
        waits = []
        for _ in range(5):
            page = browser.new_page(viewport={"width": 1200, "height": 800})
            start = time.perf_counter()
            page.goto(path.as_uri(), wait_until="commit")
            page.locator("#samples tbody button").first.wait_for(state="attached")
            page.locator(".plot.live").last.wait_for(state="attached")
            page.evaluate("1")  # the page answers: its scripts have run
            waits.append(time.perf_counter() - start)
            page.close()
        browser.close()
        print(f"interactive after {np.median(waits):.2f} s (median of {len(waits)}, wall time)")


if __name__ == "__main__":
    if "--report" in sys.argv[1:]:
        report_table()
    else:
        sys.exit(0 if plot_table() else 1)
