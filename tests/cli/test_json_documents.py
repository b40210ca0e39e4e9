"""JSON documents of commands that write files, and one vocabulary of their options."""

import json
from pathlib import Path

import pytest
from command_line import json_of, stdout_of
from study_runs import SMALL_STUDY

RIG = """[camera.c]
link = "world"
width = 640
height = 480
[board.b]
link = "tip"
type = "checkerboard"
columns = 7
rows = 5
square_mm = 30
"""
TARGETS = "x[mm],y[mm],z[mm]\n600,0,300\n9000,0,0\n"
COMMANDS = {
    "convert": (["arm.dh.toml", "new.urdf"], {"output": "new.urdf"}, ["arm.dh.toml"]),
    "view": (["arm.dh.toml", "--html", "p.html"], {"html": "p.html"}, ["arm.dh.toml"]),
    "simulate": (["arm.dh.toml", "-n", "3", "-o", "s.csv"], {"output": "s.csv"}, ["arm.dh.toml"]),
    "compensate": (
        ["arm.dh.toml", "arm.dh.toml", "t.csv", "-o", "c.csv", "--export", "c.trajectory.csv"],
        {"output": "c.csv", "export": "c.trajectory.csv"},
        ["arm.dh.toml", "t.csv"],
    ),
    "export": (["arm.dh.toml", "-o", "m.py"], {"output": "m.py"}, ["arm.dh.toml"]),
    "board": (["rig.toml", "-o", "b.pdf"], {"output": "b.pdf"}, ["rig.toml"]),
    "study": (["s.study.toml", "-o", "r.csv"], {"output": "r.csv"}, ["s.study.toml"]),
}


@pytest.fixture
def files(robot_folder):
    Path("rig.toml").write_text(RIG)
    Path("t.csv").write_text(TARGETS)
    Path("s.study.toml").write_text(SMALL_STUDY.replace("seeds = 120", "seeds = 2"))


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_prints_only_json(run, files, command):
    words, written, inputs = COMMANDS[command]
    document = json_of(run(command, *words, "--json", "-"))
    assert document["files"] == written
    assert set(inputs) <= set(document["inputs"])
    assert all(Path(path).exists() for path in written.values())


def test_facts_of_the_documents(run, files):
    facts = {
        command: json.loads(run(command, *COMMANDS[command][0], "--json", "-")[1]) for command in COMMANDS
    }
    assert facts["simulate"]["samples"] == 3
    assert (facts["compensate"]["targets"], facts["compensate"]["reached"]) == (2, 1)
    assert facts["compensate"]["status"][1] == "out of reach"
    assert facts["board"]["board"] == "b"
    assert [row["kind"] for row in facts["study"]["settings"]] == ["pose", "position"]


def test_detect_lists_images_without_a_board(run, files):
    cv2 = pytest.importorskip("cv2")
    np = pytest.importorskip("numpy")
    cv2.imwrite("empty.png", np.full((480, 640), 255, np.uint8))
    status, out, err = run("detect", "empty.png", "--rig", "rig.toml", "-o", "k.csv", "--json", "-")
    if status == 0:
        (board,) = json.loads(out)["boards"]
        assert (board["board"], board["images"], board["used"]) == ("b", 1, 0)
        assert list(board["problems"]) == ["empty.png"]
    else:
        assert (status, out) == (2, ""), err


def test_old_and_new_names_of_options_do_the_same(run, robot_folder):
    texts = []
    for words in (["-m", "4", "--noise", "0.1mm"], ["-n", "4", "--sigma", "0.1mm"]):
        assert run("simulate", "arm.dh.toml", *words, "-o", "s.csv")[0] == 0
        texts.append(Path("s.csv").read_text())
    assert texts[0] == texts[1]
    plans = []
    for word, noise in (("-n", "--sigma"), ("-m", "--noise"), ("--samples", "--sigma")):
        words = ["arm.dh.toml", word, "8", noise, "0.1mm,0.01deg", "--candidates", "50", "-o", "p.csv"]
        stdout_of(run("plan", *words))
        plans.append(Path("p.csv").read_text())
    assert plans[0] == plans[1] == plans[2]
