"""Pictures of the tour: a UR10 in front of a laser tracker, series D in notebooks/data.

    python docs/evidence/tour.py FOLDER [PICTURE ...]

The calibration is that of the tour's command `dhcal calibrate`. The learning curve is drawn from
docs/evidence/leaderboard and docs/evidence/tour/learning.json. `sphinx-build` calls `draw`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

import dhcal_pin as dh
from dhcal_pin.calibration import split
from dhcal_pin.measurements.measured_region import draw_joint_space
from dhcal_pin.plots import COLORS, new_axes
from dhcal_pin.ros_packages import resolve_robot_path

HERE = Path(__file__).resolve().parent
DATA = HERE.parents[1] / "notebooks" / "data" / "ipa_ur10"


def calibrate() -> dh.Result:
    """Calibrate half of the poses; the other half is held out, the same one as by `--holdout 0.5`."""
    arm = dh.Chain.from_urdf(resolve_robot_path("example:ur10"), tip="tool0")
    path = DATA / "Series_D" / "measurements_iso_cubes.csv"
    data = dh.read_measurements(path, arm, columns=DATA / "columns.toml")
    (fit,), (held,) = split([data], 0.5)
    return dh.calibrate(arm, fit, holdout=held)


def draw_content(fit: dh.Result) -> Axes:
    """Draw where the tool was and which part of the limits each joint covers."""
    left, right = new_axes(2, (4.6, 3.4))
    q = np.concatenate([item.q for item in (*fit.data, *fit.holdout)])
    nominal = fit.nominal_refitted
    positions = 1e3 * nominal.with_base_and_tool(np.eye(4), nominal.tool).poses(q)[:, :3, 3]
    left.plot(positions[:, 0], positions[:, 2], ".", color=COLORS["before"], markersize=3)
    left.plot(0, 0, "s", color=COLORS["text"], label="base of the arm")
    left.set(xlabel="x, mm", ylabel="z, mm", title="tool positions, from the side", aspect="equal")
    left.legend(frameon=False, fontsize="small", loc="lower left")
    names = fit.chain.joint_names
    low, high = np.degrees([q.min(0), q.max(0)])
    right.barh(range(len(names)), high - low, left=low, color=COLORS["before"])
    right.set_yticks(range(len(names)), names)
    right.set(
        xlabel="measured range, degrees", title="joints", xlim=(-360, 360), ylim=(len(names) - 0.5, -0.5)
    )
    return left


def normalized_errors(fit: dh.Result) -> np.ndarray:
    """Return the position errors of the held-out poses over their predicted standard deviations, (m, 3)."""
    (held,) = fit.holdout
    prediction = fit.predict(held.q)
    std = np.sqrt(np.einsum("mii->mi", prediction.covariance)[:, :3])
    return (held.positions() - prediction.poses[:, :3, 3]) / std


def draw_certainty(fit: dh.Result) -> Axes:
    """Draw the errors of the held-out poses over their predicted standard deviations."""
    (ax,) = new_axes()
    errors = normalized_errors(fit).ravel()
    edges = np.linspace(-5, 5, 41)
    ax.hist(
        np.clip(errors, -5, 5), edges, density=True, color=COLORS["after"], alpha=0.4, label="held-out poses"
    )
    x = np.linspace(-5, 5, 201)
    ax.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color=COLORS["text"], label="as predicted")
    for edge in (-1.96, 1.96):
        ax.axvline(edge, color=COLORS["text"], linewidth=0.8, linestyle=":")
    share = 100 * np.mean(np.abs(errors) < 1.96)
    ax.set(xlabel="error / predicted standard deviation", ylabel="density")
    ax.set_title(f"{share:.0f} % of the components lie in their 95 % interval")
    ax.legend(frameon=False, fontsize="small")
    return ax


def draw_where(fit: dh.Result) -> Axes:
    """Draw the distance of held-out and of random configurations from the measured ones."""
    (ax,) = new_axes()
    region = fit.measured_region
    assert region is not None
    held = np.concatenate([item.q for item in fit.holdout])
    chosen = {
        "held-out poses": (held, "after"),
        "random joint positions": (draw_joint_space(fit.chain), "before"),
    }
    edges = np.geomspace(0.05, 20, 51)
    for label, (q, color) in chosen.items():
        distance = np.clip(region.distances(q) / region.radius, edges[0], edges[-1])
        share = 100 * np.histogram(distance, edges)[0] / len(distance)
        ax.stairs(share, edges, fill=True, color=COLORS[color], alpha=0.5, label=label)
    ax.axvline(1, color=COLORS["text"], label="edge of the measured region")
    ax.set(
        xlabel="distance from the measured configurations / radius of the region",
        ylabel="share, %",
        xscale="log",
    )
    ax.legend(frameon=False, fontsize="small")
    return ax


def draw_learning() -> Axes:
    """Draw the error on the other half by the number of fitted poses, for both series."""
    (ax,) = new_axes(1, (6.4, 4.0))
    added = json.loads((HERE / "tour" / "learning.json").read_text(encoding="utf-8"))
    for name, title, style in (("dhcal_none", "geometry", "--"), ("dhcal", "all corrections", "-")):
        document = json.loads((HERE / "leaderboard" / f"{name}.json").read_text(encoding="utf-8"))
        for arm, color in (("UR10, series B", COLORS["before"]), ("UR10, series D", COLORS["after"])):
            splits = document["series"].get(arm, {}) | added[name][arm]
            cases = [
                each for split, found in splits.items() if split not in ("regions", "other") for each in found
            ]
            errors: dict[int, list[float]] = {}
            for case in sorted(cases, key=lambda case: case["fitted"]):
                # The halves of an odd number differ by one.
                near = next((count for count in errors if abs(count - case["fitted"]) < 2), case["fitted"])
                errors.setdefault(near, []).append(1e3 * case["position_rms_m"])
            counts = np.array(list(errors))
            values = np.sqrt([np.mean(np.square(each)) for each in errors.values()])
            ax.plot(counts, values, style, marker="o", markersize=4, color=color, label=f"{arm}, {title}")
            for count, each in errors.items():
                ax.plot([count, count], [min(each), max(each)], color=color, linewidth=0.8)
    ticks = [10, 20, 50, 100, 200, 400, 747]
    ax.set(
        xlabel="fitted poses", ylabel="RMS position error on the other half, mm", xscale="log", yscale="log"
    )
    ax.set_xticks(ticks, map(str, ticks))
    ax.set_yticks([0.1, 0.2, 0.5, 1], ["0.1", "0.2", "0.5", "1"])
    ax.minorticks_off()
    ax.legend(frameon=False, fontsize="small")
    return ax


def draw(folder: Path, chosen: Sequence[str] = ()) -> None:
    """Draw the chosen pictures, or all; these are kept if they are newer than this script."""
    scripts = max(path.stat().st_mtime for path in (Path(__file__), HERE / "tour" / "learning.json"))
    last = folder / "tour_remains.svg"
    if not chosen and last.exists() and last.stat().st_mtime > scripts:
        return
    fit = calibrate()
    pictures: dict[str, Callable[[], Axes]] = {
        "content": lambda: draw_content(fit),
        "accuracy": lambda: fit.plot_residuals(over="histogram"),
        "corrections": lambda: fit.plot_joint_corrections()[0],
        "certainty": lambda: draw_certainty(fit),
        "learning": draw_learning,
        "where": lambda: draw_where(fit),
        "remains": lambda: fit.plot_residuals(over="sample"),
    }
    with mpl.rc_context({"svg.hashsalt": "dhcal"}):
        for name in chosen or pictures:
            pictures[name]().figure.savefig(folder / f"tour_{name}.svg", metadata={"Date": None})


if __name__ == "__main__":
    mpl.use("agg")
    draw(Path(sys.argv[1]), sys.argv[2:])
