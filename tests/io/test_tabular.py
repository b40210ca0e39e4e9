"""Text files: CSV tables and TOML."""

from __future__ import annotations

import pytest
from robots import write

from dhcal_pin.exceptions import DhcalError
from dhcal_pin.io import read_csv_table, read_toml


def test_an_unbalanced_quote_affects_its_row_only(tmp_path):
    path = write(tmp_path, "a.csv", 'a,b\n1,2\n"3,4\n5,6\n')
    with pytest.raises(DhcalError, match=r"a\.csv:3: 1 values under a header of 2 columns"):
        read_csv_table(path)


def test_a_cell_that_is_too_long_is_an_error(tmp_path):
    with pytest.raises(DhcalError, match=r"a\.csv:2: not comma-separated text"):
        read_csv_table(write(tmp_path, "a.csv", f"a,b\n1,{'2' * 200_000}\n"))


def test_deeply_nested_toml_is_an_error(tmp_path):
    with pytest.raises(DhcalError, match="not TOML"):
        read_toml(write(tmp_path, "a.toml", "a = " + "[" * 100_000))
