"""JSON document of a calibration or validation.

The keys of the document are a contract with other programs. Lengths are in metres, angles in radians; NaN and
infinity become null.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from ..calibration.cross_validation import Generalization
from ..calibration.evaluation import Accuracy, Comparison
from ..calibration.presentation.budget import UncertaintyBudget
from ..calibration.result import Result
from ..calibration.summary import position_error_beside, position_error_of_images
from ..calibration.verdict import Verdict
from ..measurements.base import Measurement
from ..session import Session
from .provenance import versions

# Model that an accuracy after a calibration holds for: the complete one, or the URDF without its sidecar.
_Model = Literal["after", "alone"]
# Keys of an accuracy and of a parameter; further values are under `comparisons` and `priors`.
_ACCURACY = re.compile("(?!.*_axes_).+_(rms_m|max_m|rms_rad)|residual_(rms|max)|unit")
_PARAMETER = "name unit nominal value std observability posterior_to_prior_std fixed frame direction".split()


def main_statistics(accuracy: Mapping[str, Any]) -> dict[str, Any]:
    """Select RMS and largest errors."""
    return {key: value for key, value in accuracy.items() if _ACCURACY.fullmatch(key)}


def parameter_rows(fit: Result) -> list[dict[str, Any]]:
    """Return the parameters as the JSON document lists them."""
    return [{key: getattr(estimate, key) for key in _PARAMETER} for estimate in fit.estimates]


def result_to_dict(
    fit: Result,
    files: Mapping[str, str],
    inputs: Mapping[str, str],
    outliers: Sequence[int] = (),
    is_calibration: bool = True,
) -> dict[str, Any]:
    """Collect the JSON document of a calibration, or of a validation that fits base and tool."""
    comparisons = {comparison.title: comparison for comparison in fit.comparisons}
    fitted, holdout = comparisons["fitted"], comparisons.get("hold-out")
    budget = UncertaintyBudget.from_fit(fit, fit.comparisons[0])
    return {
        "verdict": fit.verdict.to_dict(),
        "converged": fit.converged,
        "iterations": fit.iterations,
        "method": fit.method,
        "samples": fit.n_samples,
        "samples_holdout": holdout.n_samples + holdout.n_outliers if holdout else 0,
        "rank": fit.rank,
        "parameters_total": len(fit.parameters),
        "uncertainty_budget": budget.to_dict() if budget else None,
        "condition": fit.condition,
        "singular_values": fit.solution.system.singular_values.tolist(),
        **_accuracies(fitted, holdout, "after"),
        **generalization_to_dict(fit.generalization if is_calibration else None),
        "urdf_alone": _accuracies(fitted, holdout, "alone")
        | _generalization_accuracies(fit.generalization if is_calibration else None, "alone"),
        "accuracy_by_file": {
            item.source or str(number): {
                "samples": comparison.n_samples,
                "outliers": comparison.n_outliers,
                "before": main_statistics(comparison.before),
                "after": main_statistics(comparison.after),
            }
            for number, (item, comparison) in enumerate(zip(fit.data, fit.file_comparisons, strict=True), 1)
        },
        "comparisons": [comparison.to_dict() for comparison in fit.comparisons],
        "parameters": parameter_rows(fit),
        "priors": {estimate.name: estimate.prior for estimate in fit.estimates if not estimate.fixed},
        "extension": fit.extension.to_dict() if fit.extension else None,
        "session": session_to_dict(fit.session),
        "signs": fit.signs.to_dict() if fit.signs else None,
        "camera_stages": [stage.to_dict() for stage in fit.camera_stages],
        "hand_eye": fit.hand_eye.to_dict() if fit.hand_eye else None,
        "hand_eye_std_m": fit.hand_eye_std,
        "position_error_of_images_m": position_error_of_images(fit),
        "position_error_beside_m": position_error_beside(fit),
        "shrinkage_factor": fit.shrinkage_factor,
        "shrinkage_notes": fit.shrinkage_notes,
        "rounding_notes": fit.rounding_notes,
        "mounting": fit.mounting.to_dict() if fit.mounting else None,
        "unobservable": fit.unobservable,
        "weakly_observable": fit.weakly_observable,
        "observability_indices": fit.observability_indices,
        "outliers": list(outliers),
        "files": dict(files),
        "versions": versions(),
        "inputs": dict(inputs),
    }


def session_to_dict(session: Session | None) -> dict[str, Any]:
    """Return what happened during the measurement; empty if this was not examined."""
    if session is None:
        return {"events": [], "drift": [], "lag": None, "scale": None, "range": None, "unordered": False}
    return session.to_dict()


def _accuracies(fitted: Comparison, holdout: Comparison | None, model: _Model) -> dict[str, Any]:
    """Return the accuracy on fitted and held-out samples, of the complete model or of the URDF alone."""
    return {
        "before": main_statistics(fitted.before),
        "after": main_statistics(_after(fitted, model)),
        "holdout_before": main_statistics(holdout.before) if holdout else {},
        "holdout_after": main_statistics(_after(holdout, model)) if holdout else {},
    }


def _after(comparison: Comparison, model: _Model) -> Accuracy:
    """Return the accuracy after a calibration; without joint errors the URDF alone is the complete model."""
    return (comparison.after_alone if model == "alone" else None) or comparison.after


def _generalization_accuracies(known: Generalization | None, model: _Model) -> dict[str, Any]:
    """Return the accuracy on configurations that are not fitted, of the complete model or the URDF alone."""
    out: dict[str, Any] = {}
    for key, name in (("cross_validated", "cross_validated"), ("holdout_region", "region_holdout")):
        comparison: Comparison | None = getattr(known, name, None)
        out[f"{key}_before"] = main_statistics(comparison.before) if comparison else None
        out[f"{key}_after"] = main_statistics(_after(comparison, model)) if comparison else None
    return out


def generalization_to_dict(known: Generalization | None) -> dict[str, Any]:
    """Return the accuracy on configurations that are not fitted, and what it says about joint space."""
    return {
        **_generalization_accuracies(known, "after"),
        "cross_validated_reason": getattr(known, "cross_validated_reason", ""),
        "holdout_region_reason": getattr(known, "region_holdout_reason", ""),
        **{name: getattr(known, name, None) for name in ("covered_share", "reached_share")},
    }


def validation_to_dict(
    data: Sequence[Measurement],
    inputs: Mapping[str, str],
    before: Mapping[str, Any],
    after: Mapping[str, Any],
) -> dict[str, Any]:
    """Collect the JSON document of a validation; it has the keys of a calibration."""
    return {
        "verdict": Verdict("ok").to_dict(),
        "converged": True,
        "iterations": 0,
        "method": "none",
        "samples": sum(len(item.q) for item in data),
        "samples_holdout": 0,
        "rank": 0,
        "parameters_total": 0,
        "uncertainty_budget": None,
        "condition": 0.0,
        "before": before,
        "after": after,
        "holdout_before": {},
        "holdout_after": {},
        **generalization_to_dict(None),
        "parameters": [],
        "unobservable": [],
        "extension": None,
        "session": session_to_dict(None),
        "shrinkage_factor": 1.0,
        "shrinkage_notes": [],
        "rounding_notes": [],
        "weakly_observable": [],
        "observability_indices": {},
        "outliers": [],
        "outliers_by_file": {},
        "files": {},
        "versions": versions(),
        "inputs": dict(inputs),
    }


def json_text(content: Any) -> str:
    """Format a document as JSON; NaN and infinity become null."""

    def clean(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: clean(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [clean(item) for item in value]
        if isinstance(value, float) and not math.isfinite(value):
            return None
        return value

    text = json.dumps(clean(content), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    # A file name need not be UTF-8. Python keeps its other bytes as surrogates, which become JSON escapes.
    return text.encode(errors="backslashreplace").decode()
