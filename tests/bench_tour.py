"""Further numbers of poses for the learning curve of the tour: docs/evidence/tour/learning.json.

    python tests/bench_tour.py [--data DIR]

The other ones are those of the leaderboard, `bench_public.py`.
"""

import argparse
import json
import sys
from pathlib import Path

from bench_public import judge
from public_programs import PROGRAMS, Task
from public_series import SERIES, cases
from robots import DATA, ROOT

COUNTS = (10, 200, 400)


def main() -> None:
    """Judge both series of the UR10."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA, metavar="DIR", help="folder of the measurements")
    args = parser.parse_args()
    found: dict[str, dict] = {name: {} for name in ("dhcal_none", "dhcal")}
    for series in SERIES[:2]:
        read = series.read(args.data)
        assert read is not None, f"{series.arm} is missing"
        chain, measured = read
        for name, results in found.items():
            results[series.arm] = {}
            for count in map(str, COUNTS):
                judged_cases = [
                    judge(
                        PROGRAMS[name],
                        Task(chain, measured.take(fit), series.sets, measured.q, count),
                        measured.take(judged),
                    )
                    for fit, judged in cases(measured, count)
                ]
                # The smaller series has no half of so many poses.
                if judged_cases:
                    results[series.arm][count] = judged_cases
                print(name, series.arm, count, file=sys.stderr, flush=True)
    path = ROOT / "docs" / "evidence" / "tour" / "learning.json"
    path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
