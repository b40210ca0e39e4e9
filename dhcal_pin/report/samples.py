"""Samples of a page: where they come from, the robot's pose and the errors.

The scripts of the page draw, list and select these samples. Their poses are computed here, so that the page
shows the same numbers as Python.

Shapes: N samples in the order of their files and lines, n joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np

from .. import se3
from .._frozen import frozen
from .._typing import Array
from ..calibration.result import Result
from ..formatting import SMALL_UNITS, UNITS, Quantity, Table
from ..io.tabular import csv_text
from ..measurements.base import Measurement
from ..measurements.groups import ERROR_GROUPS, in_order
from ..robot.chain import Chain
from ..subsampling import evenly_spaced_indices
from .document import Section
from .json_document import parameter_rows

# Largest number of samples that a page contains beside the outliers; more would make it large and slow.
MAX_SAMPLES = 5000
# Samples with the largest errors that the table of samples lists without scripts.
MAX_LISTED_SAMPLES = 20
# Decimals of numbers in the page: positions, angles and errors in SI units.
_POSE_DECIMALS, _ERROR_DECIMALS, _MAP_DECIMALS = 12, 9, 5
# Roles of samples, in the order of their legend.
ROLES = ("fitted", "hold-out", "measured", "planned")


@frozen(eq=False)
class Samples:
    """Samples that a reader can select on a page."""

    chain: Chain  # Robot whose tool poses are shown
    file: Array  # File of each sample, (N,)
    line: Array  # Line of each sample in its file, (N,)
    number: Array  # Number of each sample; numbers continue over the files, (N,)
    role: Array  # One of `ROLES` for each sample, (N,)
    is_outlier: Array  # Whether each sample is an outlier, (N,)
    q: Array  # Joint positions of its first configuration, (N, n) [rad or m]; NaN if it has none
    # Error norms by group and state ("before", "after"), (N,) each [m or rad]; NaN without this group.
    errors: Mapping[str, Mapping[str, Array]]
    downloads: Mapping[str, str] = field(default_factory=dict)  # Files to download from the page, by name
    note: str = ""  # Sentence about samples that the page does not contain; empty if it has all

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.line)

    def limited(self) -> Samples:
        """Return these samples, or all outliers and an even choice of the others if there are too many."""
        if len(self) <= MAX_SAMPLES:
            return self
        chosen = np.union1d(evenly_spaced_indices(len(self), MAX_SAMPLES), np.flatnonzero(self.is_outlier))
        note = f"The page contains {len(chosen)} of the {len(self)} samples; --residuals writes all of them."
        downloads = {name: text for name, text in self.downloads.items() if name != "residuals.csv"}
        return replace(self.take(chosen), downloads=downloads, note=note)

    def take(self, chosen: Array) -> Samples:
        """Return the samples of some indices."""
        names = ("file", "line", "number", "role", "is_outlier", "q")
        values: dict[str, Any] = {name: getattr(self, name)[chosen] for name in names}
        values["errors"] = {
            group: {state: norms[chosen] for state, norms in states.items()}
            for group, states in self.errors.items()
        }
        return replace(self, **values)

    def page_data(self) -> dict[str, Any]:
        """Return what the scripts of the page read, as JSON-compatible values."""
        files, file_index = np.unique(self.file.astype(str), return_inverse=True)
        roles = [role for role in ROLES if role in self.role]
        has_pose = np.isfinite(self.q).all(1)
        poses = self.chain.poses(self.q[has_pose])
        tool, base = np.full((len(self), 6), np.nan), np.full((len(self), 3), np.nan)
        tool[has_pose, :3] = poses[:, :3, 3]
        tool[has_pose, 3:] = se3.log3(poses[:, :3, :3])
        base[has_pose] = (se3.inverse(self.chain.base) @ poses)[:, :3, 3]
        return {
            "joints": [
                {"name": name} | _shown_unit(*UNITS[joint_unit(self.chain, i)])
                for i, name in enumerate(self.chain.joint_names)
            ],
            "groups": [
                {"key": group, "label": ERROR_GROUPS[group].label}
                | _shown_unit(*SMALL_UNITS[ERROR_GROUPS[group].unit])
                for group in self.errors
            ],
            "files": files.tolist(),
            "file": file_index.tolist(),
            "line": self.line.tolist(),
            "number": self.number.tolist(),
            "roles": roles,
            "role": [roles.index(role) for role in self.role],
            "outlier": self.is_outlier.astype(int).tolist(),
            "q": _columns(self.q, _POSE_DECIMALS),
            "tool": _columns(tool, _POSE_DECIMALS),
            "base": _columns(base, _MAP_DECIMALS),
            "errors": {
                group: {state: _values(values, _ERROR_DECIMALS) for state, values in states.items()}
                for group, states in self.errors.items()
            },
            "downloads": dict(self.downloads),
        }


def samples_section(samples: Samples, title: str = "Samples") -> Section:
    """List the samples with the largest errors; scripts of the page make it a list of all samples."""
    groups = {
        group: states["after"]
        for group, states in samples.errors.items()
        if np.isfinite(states["after"]).any()
    }
    largest = np.arange(len(samples))
    text = f"The first {min(len(samples), MAX_LISTED_SAMPLES)} of {len(samples)}."
    if groups:
        first = next(iter(groups.values()))
        largest = np.argsort(-np.nan_to_num(first, nan=-1.0), kind="stable")
        label = ERROR_GROUPS[next(iter(groups))].label
        text = f"The {min(len(samples), MAX_LISTED_SAMPLES)} samples with the largest {label}."
    shown = largest[:MAX_LISTED_SAMPLES]
    joints = samples.chain.joint_names
    rows = [
        [
            samples.file[i],
            str(samples.line[i]),
            samples.role[i] + (", outlier" if samples.is_outlier[i] else ""),
            *(Quantity(float(samples.q[i, j]), joint_unit(samples.chain, j)) for j in range(len(joints))),
            *(Quantity.error(float(errors[i]), ERROR_GROUPS[group].unit) for group, errors in groups.items()),
        ]
        for i in shown
    ]
    header = ["file", "line", "set", *joints, *(ERROR_GROUPS[group].label for group in groups)]
    sentences = [text, *filter(None, [samples.note])]
    return Section("samples", title, sentences, tables=[Table(header, rows)] if rows else [])


def joint_unit(chain: Chain, joint: int) -> str:
    """Return the SI unit of an independent joint of a chain."""
    return "m" if chain.is_prismatic[joint] else "rad"


def _shown_unit(factor: float, unit: str) -> dict[str, Any]:
    """Return a factor from SI units, and the unit, as the scripts read them."""
    return {"factor": factor, "unit": unit.strip()}


def _columns(values: Array, decimals: int) -> list[list[float | None]]:
    return [_values(column, decimals) for column in values.T]


def _values(values: Array, decimals: int) -> list[float | None]:
    """Round numbers; those that are not finite become None."""
    rounded = np.round(values, decimals) + 0.0
    return [value if np.isfinite(value) else None for value in rounded.tolist()]


def measured_samples(
    chain: Chain,
    names: Sequence[str],
    data: Sequence[Measurement],
    norms: Mapping[str, Mapping[str, Array]],
) -> Samples:
    """Collect the samples of measurements, whose files are named; `norms` are by state and group."""
    last_rows: dict[str, int] = {}
    for name, item in zip(names, data, strict=True):
        last_rows[name] = max(last_rows.get(name, 0), int(item.rows.max()))
    # The samples of a file are numbered after the last line of the file before it.
    starts = dict(zip(last_rows, np.cumsum([0, *last_rows.values()]).tolist(), strict=False))
    counts = [len(item.rows) for item in data]
    file, line = np.repeat(np.array(names, object), counts), np.concatenate([item.rows for item in data])
    without = [np.nan] * chain.n_joints
    q = [item.q if item.configurations_per_row else [without] * len(item.rows) for item in data]
    return Samples(
        chain=chain,
        file=file,
        line=line,
        number=np.array([starts[name] for name in file]) + line,
        role=np.full(len(line), "measured"),
        is_outlier=np.zeros(len(line), bool),
        q=np.concatenate(q),
        errors={
            group: {state: by_group[group] for state, by_group in norms.items()}
            for group in in_order(norms["after"])
        },
    )


def result_samples(fit: Result, data_names: Sequence[str], holdout_names: Sequence[str]) -> Samples:
    """Collect the samples of a calibration, in the order of their files and lines."""
    table, names, data = fit.residuals, [*data_names, *holdout_names], [*fit.data, *fit.holdout]
    norms = {
        state: {group: pair[i] for group, pair in fit.error_norms.items()}
        for i, state in enumerate(("before", "after"))
    }
    samples = replace(
        measured_samples(fit.chain, names, data, norms),
        role=np.where(table.is_holdout, "hold-out", "fitted"),
        is_outlier=table.is_outlier,
    ).take(table.file_order)
    # As --residuals writes them.
    residuals = csv_text(table.file_columns() | {"file": samples.file.tolist()})
    return replace(samples, downloads={"residuals.csv": residuals, "parameters.csv": parameters_text(fit)})


def parameters_text(fit: Result) -> str:
    """Render the parameters of a calibration as CSV, with the keys of the JSON document."""
    rows = parameter_rows(fit)
    return csv_text({key: [_cell(row[key]) for row in rows] for key in rows[0]} if rows else {})


def _cell(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value
