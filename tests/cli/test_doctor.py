"""Command doctor."""

import re
import sys
from importlib import metadata

import numpy as np
import pytest
from command_line import parse_json

from dhcal_pin.diagnostics import check_calibration, installation


def checks_of(out):
    """Return the checks of a JSON document by name."""
    return {check["name"]: check for check in parse_json(out)["checks"]}


def test_installation_is_described(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, out, err = run("doctor", "--json", "-")
    assert status == 0
    assert parse_json(out)["works"] is True
    checks = checks_of(out)
    assert f"pin {metadata.version('pin')}" in checks["versions"]["text"]
    assert {"kernels", "BLAS", "browser", "example robots", "self-test"} <= set(checks)
    assert {"extra bags", "extra cluster", "extra excel", "extra parquet", "extra robots"} <= set(checks)
    assert not {"extra dev", "extra docs"} & set(checks)
    assert checks["self-test"]["status"] == "ok"
    errors = re.findall(r"within (\S+) m", checks["self-test"]["text"])
    assert [float(error) < 1e-9 for error in errors] == [True]
    assert all(name in err for name in checks)
    assert list(tmp_path.iterdir()) == []


def test_missing_extra_is_a_note_with_its_remedy(run, monkeypatch):
    version = metadata.version

    def without_openpyxl(name):
        if name == "openpyxl":
            raise metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(installation.metadata, "version", without_openpyxl)
    tested = installation.InstallationCheck("self-test", "ok", "")
    monkeypatch.setattr(installation, "check_calibration", lambda: tested)
    status, out, _ = run("doctor", "--json", "-")
    excel = checks_of(out)["extra excel"]
    assert (status, excel["status"]) == (0, "note")
    assert excel["text"] == "openpyxl is not installed; pip install openpyxl"


@pytest.mark.parametrize("broken", ["wrong", "raises"])
def test_broken_installation_fails_the_self_test(run, monkeypatch, broken):
    calibrate = installation.calibrate

    def broken_calibrate(chain, data, *args, **options):
        if broken == "raises":
            raise np.linalg.LinAlgError("no convergence")
        return calibrate(chain, data.take(np.s_[:2]), *args, **options)

    monkeypatch.setattr(installation, "calibrate", broken_calibrate)
    assert check_calibration().status == "failed"
    status, _, err = run("doctor")
    assert status == 1
    assert "failed  self-test" in err


def test_package_that_cannot_be_imported_is_named(run, monkeypatch):
    monkeypatch.delitem(sys.modules, "dhcal_pin.diagnostics.installation")
    monkeypatch.setitem(sys.modules, "dhcal_pin.diagnostics.installation", None)
    status, out, err = run("doctor")
    assert (status, out, err.count("\n")) == (1, "", 1)
    assert err.startswith("failed  imports: ")
    assert "installation" in err
