"""What was done and found: the JSON document, and where a result comes from."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from .._typing import PathLike
from ..calibration.evaluation import Comparison, accuracy
from ..calibration.model_selection import FamilyTrial
from ..calibration.result import Result
from ..estimation import qr
from ..measurements.base import Measurement
from ..robot.chain import Chain


@dataclass(frozen=True)
class Provenance:
    """Where a result comes from, as far as it does not know that itself.

    Attributes:
        command: the command line that made it, without where it wrote.
        inputs: SHA-256 of each input file, by path.
        names: the file of each item of the fitted data; empty where they came from Python.
        holdout_names: the same of the items held out.
        settings: further choices, in words by name.
        excluded_rows: reasons by file and row of what was not used at all.
        warnings: what is hard to believe, by file.
        remarks: sentences that belong beside the headline.
        trials: what each family of joints' transmission errors brought, where they were tried.
        hint: what they might bring, where they were not.
        comparison: accuracy on samples that were each left out of a fit, where none were held out.
    """

    command: str = ""
    inputs: Mapping[str, str] = field(default_factory=dict)
    names: Sequence[str] = ()
    holdout_names: Sequence[str] = ()
    settings: Mapping[str, str] = field(default_factory=dict)
    excluded_rows: Mapping[str, Mapping[int, str]] = field(default_factory=dict)
    warnings: Mapping[str, Sequence[str]] = field(default_factory=dict)
    remarks: Sequence[str] = ()
    trials: Sequence[FamilyTrial] = ()
    hint: str = ""
    comparison: Comparison | None = None


def file_digests(paths: Sequence[PathLike]) -> dict[str, str]:
    """SHA-256 of each input file, by path as given."""
    return {str(path): hashlib.sha256(Path(path).read_bytes()).hexdigest() for path in paths}


def versions() -> dict[str, str]:
    """Versions of what computed the result."""
    return {name: metadata.version(name) for name in ("dhcal-pin", "pin", "numpy", "scipy")}


def short_names(paths: Sequence[PathLike]) -> dict[str, str]:
    """Each path's last parts, as few as tell them apart.

    >>> short_names(["a/front/hole.csv", "a/back/hole.csv", "arm.urdf"])
    {'a/front/hole.csv': 'front/hole.csv', 'a/back/hole.csv': 'back/hole.csv', 'arm.urdf': 'arm.urdf'}
    """
    parts = {os.fspath(path): Path(path).parts for path in paths}

    def tail(path: str) -> str:
        for count in range(1, len(parts[path])):
            mine = parts[path][-count:]
            if all(other[-count:] != mine for name, other in parts.items() if name != path):
                return "/".join(mine)
        return path

    return {path: tail(path) for path in parts}


# What the document says of accuracy and of a parameter; all that is known is under `comparisons`, `priors`.
_ACCURACY = "position_rms_m position_max_m orientation_rms_rad residual_rms residual_max unit".split()


_PARAMETER = "name unit nominal value std observability posterior_to_prior_std fixed".split()


def _select_keys(found: Mapping[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    return {key: found[key] for key in keys if key in found}


def main_statistics(found: Mapping[str, Any]) -> dict[str, Any]:
    """RMS and largest errors of what `accuracy` found."""
    return _select_keys(found, _ACCURACY)


def result_to_dict(
    fit: Result, files: Mapping[str, str], inputs: Mapping[str, str], outliers: Sequence[int] = ()
) -> dict[str, Any]:
    """The JSON document of a calibration."""
    found = {c.title: c for c in fit.comparisons}
    held = found.get("hold-out")
    return {
        "converged": fit.converged,
        "iterations": fit.iterations,
        "method": fit.method,
        "samples": fit.n_samples,
        "samples_holdout": held.n_samples if held else 0,
        "rank": fit.rank,
        "parameters_total": len(fit.parameters),
        "condition": fit.condition,
        "singular_values": qr.singular_values(fit.solution.system.r).tolist(),
        "before": main_statistics(found["fitted"].before),
        "after": main_statistics(found["fitted"].after),
        "holdout_before": main_statistics(held.before) if held else {},
        "holdout_after": main_statistics(held.after) if held else {},
        "comparisons": [comparison.to_dict() for comparison in fit.comparisons],
        "parameters": [_select_keys(asdict(estimate), _PARAMETER) for estimate in fit.estimates],
        "priors": {estimate.name: estimate.prior for estimate in fit.estimates if not estimate.fixed},
        "shrinkage_factor": fit.shrinkage_factor,
        "shrinkage_notes": fit.shrinkage_notes,
        "unobservable": fit.unobservable,
        "weakly_observable": fit.weakly_observable,
        "observability_indices": fit.observability_indices,
        "outliers": list(outliers),
        "files": dict(files),
        "versions": versions(),
        "inputs": dict(inputs),
    }


def validation_to_dict(
    chain: Chain, data: Sequence[Measurement], inputs: Mapping[str, str], known: Mapping[str, float]
) -> dict[str, Any]:
    """The same document of a model that nothing was fitted to but instruments' unknown values."""
    found = main_statistics(accuracy(chain, data, known))
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
        "shrinkage_factor": 1.0,
        "shrinkage_notes": [],
        "weakly_observable": [],
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
