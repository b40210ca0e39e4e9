"""Certificate: one or two printed pages about a calibration, for quality records.

The user states as metadata what the calibration does not know: serial number, instrument, operator and date.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace

from .._typing import PathLike
from ..calibration.result import Result
from ..exceptions import InvalidArgumentError
from ..saving import write_files
from .calibration_report import calibration_document
from .context import ReportContext
from .html import html_certificate, is_html
from .provenance import Provenance, short_names, versions

# Metadata that a quality record usually needs, in their order; others follow.
META_LABELS = {
    "robot": "Robot",
    "serial": "Serial number",
    "controller": "Controller",
    "instrument": "Instrument",
    "temperature": "Temperature",
    "location": "Location",
    "date": "Date of measurement",
    "operator": "Operator",
}
# Metadata that every certificate shows, with a line to fill in by hand where they are not given.
REQUIRED_META = ("serial", "instrument", "date", "operator")


def write_certificate(
    fit: Result, path: PathLike, meta: Mapping[str, str] | None = None, source: Provenance | None = None
) -> None:
    """Write the certificate of a calibration.

    Args:
        fit: Result of the calibration.
        path: File to write, `.html`. An existing file is replaced.
        meta: Facts about the measurement, such as `{"serial": "2019300456", "date": "2026-03-01"}`; see
            `META_LABELS` for the keys with labels. Other keys are their own labels.
        source: Files, hashes and settings, which a result does not contain.
    """
    if not is_html(path):
        raise InvalidArgumentError(f"{os.fspath(path)}: unknown ending; write a certificate as .html")
    write_files({path: certificate_page(fit, meta or {}, source or Provenance())})


def parse_meta(texts: Sequence[str]) -> dict[str, str]:
    """Parse the values of --meta."""
    meta: dict[str, str] = {}
    for text in texts:
        key, sign, value = (part.strip() for part in text.partition("="))
        if not (key and sign and value):
            raise InvalidArgumentError(
                f"--meta {text}: expected KEY=VALUE, such as serial=2019300456; keys are "
                f"{', '.join(META_LABELS)} or any others"
            )
        if key in meta:
            raise InvalidArgumentError(f"--meta {text}: {key} is given twice; expected one value per key")
        meta[key] = value
    return meta


def certificate_page(fit: Result, meta: Mapping[str, str], source: Provenance) -> str:
    """Render the certificate of a calibration."""
    context = ReportContext(fit, source)
    document = calibration_document(context, "certificate")
    title = f"Calibration certificate: {meta.get('robot') or context.robot_name}"
    facts = _facts({"robot": context.robot_name} | dict(meta))
    return html_certificate(replace(document, title=title, facts=facts, records=_records(context)))


def _facts(meta: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return labels and values of the metadata; an empty value leaves a line to fill in."""
    keys = [key for key in META_LABELS if key in meta or key in REQUIRED_META]
    others = [key for key in meta if key not in META_LABELS]
    return [(META_LABELS.get(key, key), meta.get(key, "")) for key in (*keys, *others)]


def _records(context: ReportContext) -> list[tuple[str, str]]:
    """Return what is needed to repeat the calibration: data, command, files with hashes, versions."""
    fit, source = context.fit, context.source
    counts = [
        f"{name}: {len(item.rows)} {item.kind}"
        for name, item in zip(context.data_names, fit.data, strict=True)
    ]
    held_out = sum(len(item.rows) for item in fit.holdout)
    outliers = len(context.outliers)
    records = [
        ("Fitted samples", "; ".join(counts)),
        ("Hold-out samples", str(held_out) if held_out else "none"),
        ("Outliers", str(outliers) if outliers else "none"),
        ("Parameters", f"{fit.rank} identifiable of {len(fit.parameters)} estimated"),
    ]
    if source.command:
        records.append(("Command", source.command))
    for digests, role in ((source.inputs, "input"), (source.outputs, "result")):
        short = short_names(list(digests))
        records += [(f"SHA-256 of the {role} {short[path]}", digest) for path, digest in digests.items()]
    records.append(("Software", ", ".join(f"{name} {version}" for name, version in versions().items())))
    return records
