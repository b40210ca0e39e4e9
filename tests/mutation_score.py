"""Mutation score: how many small errors in the code the tests notice.

Each mutant is a copy of the package with one changed expression. The tests that execute its statement run on
it until the first one fails, the fast ones first. A mutant that survives is printed with its place; either a
test is missing, or the change has no effect that matters.

    python tests/mutation_score.py --mutants 400 --minutes 60 --seed 0 --results score.jsonl
    python tests/mutation_score.py --modules session io/bundle.py --tests session cli/test_bundle.py ...

The run is long and not part of continuous integration. It starts with one run of the tests that records which
lines each of them executes (`score.lines` and `score.times`). Each outcome is appended to the file of
results; a run with the same file and seed goes on where the last one has ended. Mutants are drawn at random
from the modules, weighted by their numbers of expressions. Coverage makes the tests several times slower when
their lines are recorded: name the tests that concern the modules.
"""

import argparse
import ast
import copy
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from importlib.util import cache_from_source
from pathlib import Path

from coverage import CoverageData

ROOT = Path(__file__).resolve().parents[1]
# Packages whose modules are changed, unless others are named.
PACKAGES = ("estimation", "identifiability", "calibration", "measurements", "robot", "io", "_kernels")
# Tests that execute much of the package within this process, unless others are named.
TESTS = (
    *PACKAGES, "cameras", "diagnostics", "paper", "planning", "plausibility", "session",
    *(path.name for path in ROOT.glob("tests/test_*.py")),
)  # fmt: skip
# Largest sum of the recorded durations of the tests that run on a mutant [s].
MAX_DURATION = 120
# Seconds after which a run of tests ends, and its exit status then. Such a mutant does not count.
TIMEOUT, OUT_OF_TIME = 2 * MAX_DURATION, 124
# Outcome by the exit status of the tests; with any other status the mutant is killed.
OUTCOMES = {0: "survived", OUT_OF_TIME: "out of time"}
COMPARISONS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
}  # fmt: skip
OPERATORS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult}


def _changes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield changed copies of an expression or a statement."""
    new = copy.deepcopy(node)
    if isinstance(new, ast.Compare) and type(new.ops[0]) in COMPARISONS:
        new.ops[0] = COMPARISONS[type(new.ops[0])]()
        yield new
    elif isinstance(new, ast.BinOp) and type(new.op) in OPERATORS and not isinstance(new.left, ast.JoinedStr):
        new.op = OPERATORS[type(new.op)]()
        yield new
    elif isinstance(new, ast.UnaryOp) and isinstance(new.op, ast.USub | ast.Not):
        yield new.operand
    elif isinstance(new, ast.BoolOp):
        new.op = ast.Or() if isinstance(new.op, ast.And) else ast.And()
        yield new
    elif isinstance(new, ast.Constant) and isinstance(new.value, bool):
        yield ast.Constant(not new.value)
    elif isinstance(new, ast.Constant) and isinstance(new.value, int):
        yield ast.Constant(new.value + 1)
    elif isinstance(new, ast.Constant) and isinstance(new.value, float):
        yield ast.Constant(10 * new.value if new.value else 1.0)
    elif isinstance(new, ast.IfExp):
        yield new.body
    elif isinstance(new, ast.If | ast.While):
        new.test = ast.UnaryOp(ast.Not(), new.test)
        yield new


def _is_ignored(parent: ast.AST, field: str) -> bool:
    """Return whether a field holds an annotation, a decorator, a part of a text, or what `zip` checks."""
    is_check = isinstance(parent, ast.keyword) and parent.arg == "strict"
    is_text = isinstance(parent, ast.JoinedStr)
    return field in ("annotation", "returns", "decorator_list") or is_check or is_text


def mutants(source: str) -> list[tuple[int, int]]:
    """Return the line of each possible mutant and its number, which `mutate` takes."""
    return [(line, number) for number, (line, *_) in enumerate(_places(ast.parse(source)))]


def _places(tree: ast.AST) -> Iterator[tuple[int, ast.AST, str, int | None, ast.AST]]:
    """Yield line, parent, field, index in the field and new node of each mutant, in a fixed order."""
    for field, value in ast.iter_fields(tree):
        if _is_ignored(tree, field):
            continue
        for index, node in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if isinstance(node, ast.AST):
                for new in _changes(node):
                    yield getattr(node, "lineno", 0), tree, field, index, new
                yield from _places(node)


def mutate(source: str, number: int) -> tuple[str, str]:
    """Return the source of a mutant, and what is changed."""
    tree = ast.parse(source)
    line, parent, field, index, new = list(_places(tree))[number]
    value = getattr(parent, field)
    old = ast.unparse(value if index is None else value[index]).split("\n")[0]
    ast.copy_location(new, value if index is None else value[index])
    if index is None:
        setattr(parent, field, new)
    else:
        value[index] = new
    return ast.unparse(
        ast.fix_missing_locations(tree)
    ), f"{line}: {old}  ->  {ast.unparse(new).splitlines()[0]}"


class ExecutedLines:
    """Tests that execute each line of the package, and their durations.

    Attributes:
        lines: Data of the package coverage, with one context per test.
        seconds: Duration of each test [s].
        failing: Tests that fail without a mutant.
    """

    def __init__(self, results: Path, tests: list[str]):
        lines, times = results.with_suffix(".lines"), results.with_suffix(".times")
        if not times.exists():
            _record(lines, times, tests)
        self.lines = CoverageData(str(lines))
        self.lines.read()
        text = times.read_text()
        found = re.findall(r"^([\d.]+)s call +(tests/.*?) *$", text, re.MULTILINE)
        self.seconds = {test: float(duration) for duration, test in found}
        self.failing = set(re.findall(r"^(?:FAILED|ERROR) (tests/.*?)(?: - .*)?$", text, re.MULTILINE))

    def tests_of(self, module: Path, line: int) -> list[str]:
        """Return the tests that execute a line, the fast ones first, up to `MAX_DURATION`.

        The lines of definitions are executed when a module is loaded. They get the tests of the whole module.
        """
        tests_by_line = self.lines.contexts_by_lineno(str(module))
        executed = [set(tests_by_line.get(each, ())) for each in _lines_of_statement(module, line)]
        tests = set().union(*executed) - {""}
        if any("" in each for each in executed) or not tests:
            tests = set().union(*tests_by_line.values()) - {""}
        names = {test.rsplit("|", 1)[0] for test in tests} - self.failing
        chosen, total = [], 0.0
        for name in sorted(names, key=lambda name: (self.seconds.get(name, 0.0), name)):
            total += self.seconds.get(name, 0.0)
            if chosen and total > MAX_DURATION:
                break
            chosen.append(name)
        return chosen


def _record(lines: Path, times: Path, tests: list[str]) -> None:
    """Run the tests once, and write the lines that each of them executes and their durations."""
    options = ["-q", "-vv", "-m", "not slow", "--durations=0", "-p", "no:cacheprovider"]
    # With another value of --dist, pytest-cov stores no names of tests.
    options += ["--dist=no", "--cov=dhcal_pin", "--cov-context=test", "--cov-report="]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *(f"tests/{name}" for name in tests)],
        cwd=ROOT,
        env=os.environ | {"COVERAGE_FILE": str(lines.resolve())},
        capture_output=True,
        text=True,
        check=False,
    )
    times.write_text(done.stdout)


def _lines_of_statement(module: Path, line: int) -> range:
    """Return the lines of the innermost statement around a line, without those of its body."""
    statements = [node for node in ast.walk(ast.parse(module.read_text())) if isinstance(node, ast.stmt)]
    around = [node for node in statements if _first_line(node) <= line <= (node.end_lineno or node.lineno)]
    innermost = max(around, key=_first_line)
    body = getattr(innermost, "body", None)
    last = body[0].lineno - 1 if body else innermost.end_lineno or line
    return range(_first_line(innermost), max(last, innermost.lineno) + 1)


def _first_line(node: ast.stmt) -> int:
    """Return the first line of a statement, that of its first decorator if it has any."""
    return min([node.lineno, *(each.lineno for each in getattr(node, "decorator_list", ()))])


def main() -> None:
    """Run mutants until their number or the time is reached, and print the score and the survivors."""
    parser = argparse.ArgumentParser(description="Compute the mutation score.")
    parser.add_argument("--mutants", type=int, default=400)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--modules", nargs="+", default=PACKAGES, help="modules and packages of dhcal_pin")
    parser.add_argument("--tests", nargs="+", default=TESTS, help="files and folders of tests")
    parser.add_argument("--results", type=Path, required=True)
    options = parser.parse_args()
    known = [json.loads(line) for line in _lines(options.results)]
    decided = {each["mutant"]: each["outcome"] for each in known}
    modules = [path for name in options.modules for path in _modules(ROOT / "dhcal_pin" / name)]
    population = [(path, *each) for path in modules for each in mutants(path.read_text())]
    chosen = random.Random(options.seed).sample(population, min(options.mutants, len(population)))
    executed = ExecutedLines(options.results, options.tests)
    end = time.monotonic() + 60 * options.minutes
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(".git", ".venv"), dirs_exist_ok=True)
        # The measurements beside the repository are not copied: tests that need them are skipped.
        environment = os.environ | {"PYTHONPATH": folder, "DHCAL_REQUIRE_DATA": "0"}
        pytest = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "not slow", "-p", "no:cacheprovider"]
        chosen_tests = Path(folder) / "chosen_tests"
        for path, line, number in chosen:
            if time.monotonic() > end:
                break
            source = path.read_text()
            changed, what = mutate(source, number)
            mutant = f"{path.relative_to(ROOT)}:{what}"
            if mutant in decided:
                continue
            copied = Path(folder) / path.relative_to(ROOT)
            copied.write_text(changed)
            compiled = Path(cache_from_source(str(copied)))
            compiled.unlink(missing_ok=True)
            tests = executed.tests_of(path, line)
            # Without a name, pytest would run the whole suite.
            chosen_tests.write_text("\n".join(tests or ["--collect-only"]))
            words = ["timeout", str(TIMEOUT), *pytest, f"@{chosen_tests}"]
            done = subprocess.run(
                words, cwd=folder, env=environment, capture_output=True, text=True, check=False
            )
            copied.write_text(source)
            compiled.unlink(missing_ok=True)
            outcome = OUTCOMES.get(done.returncode, "killed")
            decided[mutant] = outcome
            by = re.findall(r"^(?:FAILED|ERROR).*", done.stdout + done.stderr, re.MULTILINE)[:1]
            with options.results.open("a") as file:
                file.write(json.dumps({"mutant": mutant, "outcome": outcome, "by": by}) + "\n")
    outcomes = list(decided.values())
    for mutant, outcome in decided.items():
        if outcome != "killed":
            print(f"{outcome}: {mutant}")
    total = len(outcomes) - outcomes.count(OUTCOMES[OUT_OF_TIME])
    print(f"{outcomes.count('killed')} of {total} mutants killed, {len(population)} possible")


def _modules(path: Path) -> list[Path]:
    """Return the modules of a package, or a module itself."""
    return sorted(path.rglob("*.py")) if path.is_dir() else [path]


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.exists() else []


if __name__ == "__main__":
    main()
