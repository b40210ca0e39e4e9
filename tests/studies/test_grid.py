"""Study files: invalid ones are refused with a message, and those of the package can be read."""

import pytest
from robots import URDF
from study_runs import SMALL_STUDY

from dhcal_pin.exceptions import DhcalError
from dhcal_pin.studies import read_study


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("poses = 12", "pose = 12"), "unknown key 'pose'; choose from robot, tip, truth"),
        (("poses = 12", "poses = 'many'"), "poses = 'many'; expected a whole number"),
        (("poses = 12", "poses = []"), "expected at least one value"),
        (("poses = 12", "poses = 0"), "poses = 0; expected a whole number from 1"),
        (("seeds = 120", "seeds = -1"), "seeds = -1; expected a whole number"),
        (("seeds = 120", "sedes = 120"), "unknown key 'sedes'"),
        (('"pose", "position"', '"gps"'), "unknown kind 'gps'; choose from pose, position"),
        (('"pose", "position"', f'"{"g" * 400}"'), r"unknown kind 'g{57}\.\.\.'; choose from pose, position"),
        (
            ("poses = 12", "pose_selection = 'best'"),
            "unknown pose_selection 'best'; choose from random, corner, planned",
        ),
        (
            ("poses = 12", "pose_selection = 'planned'\nresample_each_iteration = true"),
            "planned poses are not resampled",
        ),
        (
            ("poses = 12", "pose_selection = 'planned'\nnoise = '0mm'"),
            "standard deviations must be above zero",
        ),
        (('"pose", "position"', '"wires"'), r"kind = 'wires': wires: wire1.x is unknown"),
        (("0.5mm,0.1deg", "0.5"), "error_std '0.5': not a number with a unit"),
        (("sim_6dof.dh.toml", "none.urdf"), "none.urdf: no such file"),
        (("sim_6dof.dh.toml", f"{'9' * 400}.urdf"), "9.urdf: no such file"),
        (("poses = 12", "truth = 'sim_3dof.dh.toml'"), "arm 2 has other joints"),
        (("poses = 12", "parameters = 'dh,tol'"), "unknown parameter set 'tol'"),
        (('robot = "sim_6dof.dh.toml"', ""), "robot is missing"),
    ],
)
def test_invalid_studies_are_refused(tmp_path, change, message):
    path = tmp_path / "s.study.toml"
    path.write_text(SMALL_STUDY.replace(*change))
    with pytest.raises(DhcalError, match=message):
        read_study(path)


@pytest.mark.parametrize("path", sorted(URDF.glob("*.study.toml")), ids=lambda path: path.name)
def test_shipped_studies_can_be_read(path):
    assert read_study(path).title
