"""Mutated files of all formats through whole commands: done, or refused in one line with nothing written."""

import pytest
from file_mutations import CASES, EXAMPLES, WORD, survive
from hypothesis import HealthCheck, given, settings
from mutations import mutated

LENIENT = [HealthCheck.too_slow, HealthCheck.data_too_large]


@pytest.mark.parametrize("case", CASES, ids=repr)
def test_unchanged_files_are_read(case):
    heard = set()
    survive(case, case.data, heard)
    assert not heard


@settings(max_examples=50, deadline=None, derandomize=True, suppress_health_check=LENIENT)
@given(**EXAMPLES)
def test_commands_survive_any_file(case, mutations):
    survive(case, mutated(case.data, mutations, WORD))


@pytest.mark.slow
@settings(max_examples=50_000, deadline=None, suppress_health_check=LENIENT)
@given(**EXAMPLES)
def test_commands_survive_thousands_of_files(case, mutations):
    survive(case, mutated(case.data, mutations, WORD))
