"""A small study, and its table as `dhcal study` writes it."""

from pathlib import Path

from dhcal_pin.cli import main

SMALL_STUDY = """
title = "small"
seeds = 120
[settings]
robot = "sim_6dof.dh.toml"
kind = ["pose", "position"]
poses = 12
error_std = "0.5mm,0.1deg"
"""
# 10,000 calibrations.
LARGE_STUDY = SMALL_STUDY.replace("seeds = 120", "seeds = 1000").replace(
    "poses = 12", "poses = [8, 10, 12, 20, 30]"
)


def table_of(folder: Path, name: str, *options: str, text: str = SMALL_STUDY) -> str:
    """The CSV text of a study run in a folder; nothing but the table and its plot is left there."""
    study, out = folder / "s.study.toml", folder / f"{name}.csv"
    study.write_text(text)
    assert main.main(["study", str(study), "-o", str(out), *options]) == 0
    assert {path.suffix for path in folder.glob(f"{name}*")} - {".svg"} == {".csv"}
    return out.read_text()
