"""Certificate: one or two printed pages about a calibration, for quality records.

`page/certificate.html` is the Jinja template. The user states as metadata what the
calibration does not know: serial number, instrument, operator and date.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from .. import formatting
from .._typing import PathLike
from ..calibration import summary
from ..calibration.result import Result
from ..exceptions import InvalidArgumentError
from ..formatting import Table, format_quantity
from ..saving import write_files
from .context import measurement_names
from .document import Provenance, short_names, versions
from .html import check_html_ending

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
# Largest corrections that are listed.
MAX_CORRECTIONS = 8


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
    check_html_ending(path, "a certificate")
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
    cross_validated = source.comparison
    comparisons = (
        fit.comparisons if cross_validated is None or fit.holdout else (cross_validated, *fit.comparisons)
    )
    head = summary.headline(comparisons)
    template = formatting.html_templates().get_template("report/page/certificate.html")
    return template.render(
        title=f"Calibration certificate: {meta.get('robot') or fit.chain.model.name or 'robot'}",
        facts=_facts(fit, meta),
        verdict=fit.verdict,
        headline=head.text,
        generalization=summary.generalization_lines(fit.generalization, comparisons),
        tables=[summary.accuracy_table(comparisons), _corrections(fit)],
        records=_records(fit, source),
    )


def _facts(fit: Result, meta: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return labels and values of the metadata; an empty value leaves a line to fill in."""
    known = {"robot": fit.chain.model.name or "robot"} | dict(meta)
    keys = [key for key in META_LABELS if key in known or key in REQUIRED_META]
    others = [key for key in known if key not in META_LABELS]
    return [(META_LABELS.get(key, key), known.get(key, "")) for key in (*keys, *others)]


def _corrections(fit: Result) -> Table:
    """Return the largest corrections of the robot, in standard deviations of their priors."""
    changed = [e for e in fit.estimates if e.category == "robot" and not e.fixed and e.change]
    changed.sort(key=lambda e: -abs(e.change) / e.prior if e.prior else 0.0)
    rows = [
        [e.name, e.frame, format_quantity(e.change, e.unit, e.std, small=True), e.certainty]
        for e in changed[:MAX_CORRECTIONS]
    ]
    hidden = len(changed) - len(rows)
    caption = "Largest corrections" + (f" ({hidden} more in the report)" if hidden > 0 else "")
    header = ["parameter", "frame", "change", "standard deviation"]
    return Table(header, rows, n_text_columns=2, caption=caption)


def _records(fit: Result, source: Provenance) -> list[tuple[str, str]]:
    """Return what is needed to repeat the calibration: data, command, files with hashes, versions."""
    names = measurement_names(source.names, fit.data)
    counts = [f"{name}: {len(item.rows)} {item.kind}" for name, item in zip(names, fit.data, strict=True)]
    held_out = sum(len(item.rows) for item in fit.holdout)
    outliers = sum(len(rows) for rows in fit.outliers)
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
