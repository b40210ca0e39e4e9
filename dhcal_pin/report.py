"""What was done and found: a JSON document and a Markdown page from one result."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from . import se3
from .chain import BASE, Chain
from .files import PathLike
from .measurements import Measurement, Unknown
from .parameters import Parameter
from .result import Result, accuracy

# Keys of an accuracy, as people read them.
MEASURES = (
    ("position_rms_m", "position RMS", "m"),
    ("position_max_m", "position, largest", "m"),
    ("orientation_rms_rad", "orientation RMS", "rad"),
    ("residual_rms", "other residuals, RMS", "m"),
    ("residual_max", "other residuals, largest", "m"),
)


def fingerprints(paths: Sequence[PathLike]) -> dict[str, str]:
    """SHA-256 of each input file, by path as given."""
    return {str(path): hashlib.sha256(Path(path).read_bytes()).hexdigest() for path in paths}


def versions() -> dict[str, str]:
    """Versions of what computed the result."""
    return {name: metadata.version(name) for name in ("dhcal-pin", "pin", "numpy", "scipy")}


def _value(fit: Result, parameter: Parameter | Unknown, error: float) -> float:
    """A parameter's own value; base and tool by component of their place, the others nominal plus error."""
    frames = {BASE: fit.chain.base, fit.chain.tool_station: fit.chain.tool}
    if isinstance(parameter, Unknown) or parameter.station not in frames:
        return parameter.nominal + error
    frame = frames[parameter.station]
    six = np.concatenate([frame[:3, 3], se3.log3(frame[:3, :3])])
    return float(six @ np.array(parameter.twist))


def parameter_rows(fit: Result) -> list[dict[str, Any]]:
    """Each parameter with nominal, value, std (infinite where unknown), observability and fixed.

    `remaining` is the share that std is of what was expected before the measurement.
    """
    rows = [
        {
            "name": p.name,
            "unit": p.unit,
            "nominal": p.nominal,
            "value": _value(fit, p, float(x)),
            "std": float(std),
            "observability": float(seen),
            "remaining": float(remaining),
            "fixed": False,
        }
        for p, x, std, seen, remaining in zip(
            fit.parameters, fit.x, fit.std, fit.seen, fit.remaining, strict=True
        )
    ]
    for p in fit.errors.fixed:
        held = _value(fit, p, 0.0)
        rows.append(
            {
                "name": p.name,
                "unit": p.unit,
                "nominal": held,
                "value": held,
                "std": 0.0,
                "observability": 0.0,
                "remaining": 0.0,
                "fixed": True,
            }
        )
    return rows


def document(
    fit: Result, files: Mapping[str, str], inputs: Mapping[str, str], outliers: Sequence[int] = ()
) -> dict[str, Any]:
    """The JSON document of a calibration."""
    return {
        "converged": fit.converged,
        "iterations": fit.iterations,
        "method": fit.method,
        "samples": fit.samples,
        "samples_holdout": sum(len(item.q) for item in fit.holdout),
        "rank": fit.rank,
        "parameters_total": len(fit.parameters),
        "condition": fit.condition,
        "before": accuracy(fit.reference, fit.data),
        "after": accuracy(fit.chain, fit.data, fit.instruments),
        "holdout_before": accuracy(fit.reference, fit.holdout),
        "holdout_after": accuracy(fit.chain, fit.holdout, fit.instruments),
        "parameters": parameter_rows(fit),
        "unobservable": fit.unobservable,
        "weakly_seen": fit.weakly_seen,
        "observability_indices": fit.observability_indices,
        "outliers": list(outliers),
        "files": dict(files),
        "versions": versions(),
        "inputs": dict(inputs),
    }


def plain_document(
    chain: Chain, data: Sequence[Measurement], inputs: Mapping[str, str], known: Mapping[str, float]
) -> dict[str, Any]:
    """The same document of a model that nothing was fitted to but instruments' unknown values."""
    found = accuracy(chain, data, known)
    return {
        "converged": True,
        "iterations": 0,
        "method": "none",
        "samples": sum(len(item.q) for item in data),
        "samples_holdout": 0,
        "rank": 0,
        "parameters_total": 0,
        "condition": 0.0,
        "before": found,
        "after": found,
        "holdout_before": {},
        "holdout_after": {},
        "parameters": [],
        "unobservable": [],
        "weakly_seen": [],
        "observability_indices": {},
        "outliers": [],
        "files": {},
        "versions": versions(),
        "inputs": dict(inputs),
    }


def json_text(content: Any) -> str:
    """JSON without NaN or infinity, which become null."""

    def clean(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: clean(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [clean(item) for item in value]
        if isinstance(value, float) and not math.isfinite(value):
            return None
        return value

    text = json.dumps(clean(content), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    # A file's name need not be UTF-8; what is not becomes an escape that JSON knows.
    return text.encode(errors="backslashreplace").decode()


def shown(value: float, unit: str) -> str:
    """A length in mm or an angle in degrees for reading, others as they are; a dash where it is unknown."""
    if not math.isfinite(value):
        return "–"
    if unit == "rad":
        return f"{math.degrees(value):.4f}°"
    return f"{1e3 * value:.3f} mm" if unit == "m" else f"{value:.3g} {unit}".removesuffix(" 1")


def table(fit: Result) -> tuple[list[str], list[list[str]]]:
    """Header and rows of the parameter table as people read it."""
    rows = []
    for row in parameter_rows(fit):
        std = (
            "fixed"
            if row["fixed"]
            else ("not seen" if math.isinf(row["std"]) else shown(row["std"], row["unit"]))
        )
        rows.append(
            [
                row["name"],
                shown(row["nominal"], row["unit"]),
                shown(row["value"], row["unit"]),
                shown(row["value"] - row["nominal"], row["unit"]),
                std,
            ]
        )
    return ["parameter", "nominal", "calibrated", "change", "std"], rows


def accuracy_rows(fit: Result) -> list[list[str]]:
    """Before and after in millimetres and degrees, fitted and held out."""
    rows = []
    for title, data in (("fitted", fit.data), ("held out", fit.holdout)):
        if not data:
            continue
        title = f"{sum(len(item.q) for item in data)} {title}"
        before, after = accuracy(fit.reference, data), accuracy(fit.chain, data, fit.instruments)
        for key, label, unit in MEASURES:
            if key in before:
                rows.append([title, label, shown(before[key], unit), shown(after[key], unit)])
    return rows


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, numbers to the right."""
    lines = [
        "| " + " | ".join(header) + " |",
        "|" + "|".join([" --- "] + [" ---: "] * (len(header) - 1)) + "|",
    ]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join(lines)
