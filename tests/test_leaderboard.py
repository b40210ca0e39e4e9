"""The benchmark of programs on public measurements: splits, judgement, programs and tables."""

import json
import shutil
from dataclasses import replace

import evidence_pages
import numpy as np
import pytest
from bench_public import FOLDER, errors, statistics
from bench_studies import ARMS
from public_programs import PROGRAMS, Task, by_scipy, frames_between, nominal
from public_series import SPLITS, cases, further_series
from robots import ROOT, paper

from dhcal_pin import se3
from dhcal_pin.io import measurement_text
from dhcal_pin.measurements import PointContact, Pose
from dhcal_pin.measurements.base import Noise
from dhcal_pin.robot import Chain


@pytest.fixture(scope="module")
def measured() -> tuple[Chain, Pose]:
    """Return a nominal arm and exact poses of one with errors; each sixth configuration is measured twice."""
    rng = np.random.default_rng(3)
    arm, actual = (Chain.from_dh(paper(name)) for name in ("sim_6dof", "sim_6dof_actual"))
    q = rng.uniform(-2, 2, (120, 6))
    q[1::6] = q[::6]
    actual = actual.with_base_and_tool(se3.exp6(rng.uniform(-1, 1, 6)), actual.tool)
    return arm, Pose.simulate(actual, q, Noise(), rng)


@pytest.mark.parametrize("split", ["halves", "regions", "20", "50"])
def test_no_configuration_is_both_fitted_and_judged(split, measured):
    _, data = measured
    found = list(cases(data, split))
    assert len(found) == (4 if split == "regions" else 2)
    judged_rows = []
    for fit, judged in found:
        judged_rows.append(judged)
        assert not set(map(tuple, data.q[fit])) & set(map(tuple, data.q[judged])) or split == "regions"
        assert not set(fit) & set(judged)
        if split in ("20", "50"):
            assert len(np.unique(data.q[fit], axis=0)) == int(split)
        else:
            assert len(fit) + len(judged) == len(data.q)
    assert np.array_equal(np.sort(np.concatenate(judged_rows)), np.arange(len(data.q)))


def test_frames_between_two_lists_of_poses_are_found():
    rng = np.random.default_rng(0)
    poses = se3.exp6(rng.uniform(-1, 1, (30, 6)))
    base, tool = (
        se3.exp6(np.array([3.0, -2, 1, 0.3, -2, 1])),
        se3.exp6(np.array([0.02, 0.01, -0.03, 0.1, 0, 0.4])),
    )
    found = frames_between(poses, base @ poses @ tool)
    for each, expected in zip(found, (base, tool), strict=True):
        assert np.allclose(each, expected, atol=1e-9)


def test_a_folder_describes_a_further_series(tmp_path, measured):
    """The paper's robot as somebody else's data set."""
    _, data = measured
    folder = tmp_path / "set"
    folder.mkdir()
    shutil.copy(ROOT / "urdf/sim_6dof.dh.toml", folder / "arm.dh.toml")
    chain = Chain.from_dh(paper("sim_6dof"))
    (folder / "poses.csv").write_text(measurement_text(data, chain))
    entries = 'arm = "A"\ninstrument = "tracker"\nrobot = "arm.dh.toml"\n'
    (folder / "series.toml").write_text(entries)
    with pytest.raises(SystemExit, match="files is missing or unknown"):
        further_series(tmp_path)
    (folder / "series.toml").write_text(f'{entries}files = "*.csv"\n')
    (series,) = further_series(tmp_path)
    read = series.read(tmp_path)
    assert read is not None
    assert isinstance(read[1], Pose)
    np.testing.assert_allclose(read[1].poses, data.poses, atol=1e-9)
    with (folder / "series.toml").open("a") as file:
        file.write('columns = "columns.toml"\n')
    assert further_series(tmp_path)[0].columns == str(folder.resolve() / "columns.toml")


def test_errors_are_those_of_a_known_displacement(measured):
    _, data = measured
    twist = np.array([3e-3, 0, 4e-3, 0, 2e-3, 0])
    moved = data.poses @ se3.exp6(twist)
    moved[:, :3, 3] = data.poses[:, :3, 3] + [3e-3, 0, 4e-3]
    found = statistics(data, moved, True, fits_frames=False)
    assert found == {
        "position_rms_m": 5e-3,
        "position_p95_m": 5e-3,
        "orientation_rms_rad": 2e-3,
        "orientation_p95_rad": 2e-3,
    }
    # Other frames of the measurement explain a displacement of all poses.
    assert statistics(data, se3.exp6(twist) @ moved, False, fits_frames=True)["position_rms_m"] < 1e-8


def test_contacts_are_judged_by_the_mean_of_their_socket():
    data = PointContact(np.zeros((5, 6)), ["a", "a", "b", "b", "c"])
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = [0.0, 2.0, 5.0, 9.0, 7.0]
    position, orientation = errors(data, poses)
    assert position.tolist() == [1.0, 1.0, 2.0, 2.0]
    assert orientation is None


def test_the_method_of_the_paper_finds_an_arm_without_noise(measured):
    arm, data = measured
    fit, judged = next(cases(data, "halves"))
    task = Task(arm, data.take(fit), "dh,base,tool", data.q[judged], "halves")
    answers = [answer for answer in (nominal(task), by_scipy(task)) if answer]
    before, after = (
        statistics(data.take(judged), answer.poses, True, fits_frames=False) for answer in answers
    )
    assert before["position_rms_m"] > 1e-3
    assert after["position_rms_m"] < 1e-6
    assert by_scipy(replace(task, fit=PointContact(data.q[:2], ["a", "a"]))) is None


def test_published_files_are_complete():
    programs = evidence_pages.read_leaderboard(FOLDER)
    assert {"nominal", "scipy", "figaroh", "dhcal"} <= set(programs) <= set(PROGRAMS)
    arms = set(programs["nominal"]["series"])
    assert set(programs["dhcal"]["series"]) == arms
    for document in programs.values():
        assert set(document["series"]) <= arms
        for splits in document["series"].values():
            assert set(splits) <= set(SPLITS)
            assert "halves" in splits
    # The table of the README is that of the files.
    assert evidence_pages.summary_table(programs) in (ROOT / "README.md").read_text(encoding="utf-8")


def test_tables_pool_the_cases():
    case = {"judged": 1, "position_rms_m": 1e-3, "stated_position_rms_m": 1e-3, "seconds": 1.0}
    other = case | {"judged": 3, "position_rms_m": 3e-3, "urdf_alone": {"position_rms_m": 8e-3}}
    assert evidence_pages.pooled([case, other], "position_rms_m") == pytest.approx(np.sqrt(7) * 1e-3)
    document = {"program": "p", "version": "1", "series": {"arm": {"halves": [other, other]}}}
    text = evidence_pages.leaderboard_tables({"p": document})
    assert "| p 1 | 3.000 |" in text
    assert "| p, URDF alone | 8.000 |" in text
    assert "| p 1 | – | – | – | 1.000 | 3.00 | 1.0 |" in text


def test_studies_are_complete():
    for name in ("poses", "spread", "planned", "reflectors"):
        rows = json.loads(
            (ROOT / "docs" / "evidence" / "studies" / f"{name}.json").read_text(encoding="utf-8")
        )
        arms = {row["arm"] for row in rows}
        assert len(arms) == 6 or name == "planned"
        assert arms <= set(ARMS)
        assert all(0 < row["median_m"] <= row["p90_m"] for row in rows)
