"""Search of the causes of an error of images: which are tried, which one is named, and in which words."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from camera_setups import ARMS, simulate
from hand_eye_setups import SIGMA, faulty_setup
from scipy.spatial.transform import Rotation

from dhcal_pin import se3, select_parameters
from dhcal_pin.calibration.cameras import causes as models
from dhcal_pin.calibration.cameras import diagnosis
from dhcal_pin.calibration.cameras.causes import (
    ARM_SETS,
    CORNERS,
    GEOMETRY,
    LENS,
    LINKS,
    OFFSETS,
    PAIRING,
    POSES,
    SIZE,
    Causes,
    HandEyeData,
    file_sequence,
)
from dhcal_pin.calibration.cameras.diagnosis import DISPLACEMENT, HandEyeDiagnosis, HandEyeFit, Trial
from dhcal_pin.calibration.cameras.jitter import Jitter
from dhcal_pin.calibration.cameras.stages import ImageError
from dhcal_pin.exceptions import NotObservableError
from dhcal_pin.formatting import format_quantity


@pytest.fixture(scope="module")
def hand_eye() -> HandEyeData:
    """Six images of a right arm, board and lens."""
    chain, images, _ = faulty_setup("ur10", "nothing", 27, is_on_wrist=True, n_images=6)
    lens = {n: v for n, v in images.stated_values.items() if images.set_of(n) == "intrinsics"}
    return HandEyeData(select_parameters(chain, "base"), (images,), lens, file_sequence([images]), False)


@pytest.fixture(scope="module")
def state(hand_eye) -> Any:
    return diagnosis._State.of(hand_eye, Causes(), None)


def error(pixels: float) -> ImageError:
    return ImageError(pixels, pixels / 1e4, 99)


def trial(name: str, pixels: float = 1.0) -> Trial:
    return Trial(name, error(pixels), f"the {name}", f"Check the {name}.")


def fake_state(pixels: float, then: Any = None, is_displaced: bool = True, noise: float = 1.0) -> Any:
    """Return a state with an error, and the errors or states of further causes on top of it."""
    more = {name: e if isinstance(e, SimpleNamespace) else fake_state(e) for name, e in (then or {}).items()}
    return SimpleNamespace(error=error(pixels), noise=noise, is_displaced=is_displaced, then=more)


def diagnosed(pixels=9.0, noise=0.5, causes=(), alternatives=(), rotation=1.0, wrong=()) -> HandEyeDiagnosis:
    errors = error(pixels), error(noise)
    return HandEyeDiagnosis(*errors, causes, alternatives, causes, rotation, 1e-3, wrong, "joint values")


@pytest.mark.parametrize(
    ("base", "causes", "alternatives"),
    [
        (fake_state(10.0), [DISPLACEMENT], []),
        (fake_state(10.0, is_displaced=False), [], []),
        (fake_state(10.0, {LENS: 8.0}), [LENS, DISPLACEMENT], []),
        (fake_state(10.0, {LENS: 8.01}), [DISPLACEMENT], []),
        # Noise explains an error of 1.5 times its size.
        (fake_state(1.5, {LENS: 1.1}), [], []),
        (fake_state(1.51, {LENS: 1.1}), [LENS], []),
        # The noise is no larger than the smallest error.
        (fake_state(1.4, {LENS: 0.5}), [LENS], []),
        # Causes whose errors differ by up to 15 % are alternatives, unless they contain the first one.
        (fake_state(10.0, {SIZE: 1.0, LENS: 1.15, CORNERS: 1.0}), [SIZE], [LENS]),
        (fake_state(10.0, {SIZE: 1.0, LENS: 1.16}), [SIZE], []),
        (fake_state(10.0, {OFFSETS: 1.0, GEOMETRY: 1.0, CORNERS: 1.0}), [OFFSETS], [CORNERS]),
        (fake_state(10.0, {LENS: 1.1, OFFSETS: 1.0}), [LENS], [OFFSETS]),
        # Implausible errors of the arm are named where nothing else explains the images.
        (fake_state(10.0, {"far": 1.0, CORNERS: 1.1}), [CORNERS], []),
        (fake_state(10.0, {"far": 1.0}), ["far"], []),
        # At most three causes; alternatives are those of the first one.
        (
            fake_state(
                99.0,
                {
                    "a": fake_state(
                        50.0, {"b": fake_state(20.0, {"c": fake_state(9.0, {"d": 1.0})}), "e": 20.0}
                    )
                },
            ),
            ["a", "b", "c"],
            [],
        ),
    ],
)
def test_the_cause_with_few_unknowns_and_a_small_error_is_named(monkeypatch, base, causes, alternatives):
    monkeypatch.setattr(diagnosis, "_try_causes", lambda _, state: state.then)
    monkeypatch.setattr(diagnosis, "_trial", lambda _, name, state: trial(name, state.error.pixels))
    monkeypatch.setattr(diagnosis, "_displacement", lambda _, state: trial(DISPLACEMENT, state.error.pixels))
    monkeypatch.setattr(diagnosis, "_is_plausible", lambda name, _: name != "far")
    found, others, alone, last = diagnosis._find_causes(SimpleNamespace(), base)  # type: ignore[arg-type]
    assert [each.cause for each in found] == causes
    assert [each.cause for each in others] == alternatives
    assert [each.cause for each in alone] == list(base.then)
    expected = base
    for name in causes:
        expected = expected.then.get(name, expected)
    assert last is expected
    search = diagnosis._Search(SimpleNamespace(), base, found, others, alone, last)  # type: ignore[arg-type]
    assert search.remaining == min(base.error.pixels, last.error.pixels)
    assert search.noise == min([base.noise, *(each.error.pixels for each in (*alone, *found))])


ALL = [SIZE, LENS, CORNERS, OFFSETS, GEOMETRY]


@pytest.mark.parametrize(
    ("pixels", "causes", "errors", "changes", "tried"),
    [
        (9.0, Causes(), {}, {}, ALL),
        # Small errors have no exchanged links, and a shift is tried if nothing else explains the images.
        (10.0, Causes(), {}, {"shift": 0.5, "links": True}, [*ALL, PAIRING]),
        (10.0, Causes(), {SIZE: 1.5}, {"shift": 0.5}, ALL),
        (10.0, Causes(), {SIZE: 1.51}, {"shift": 0.5}, [*ALL, PAIRING]),
        (1.4, Causes(), {}, {"shift": 0.5}, ALL),
        (10.0, Causes(shift=1.0), {}, {"shift": 0.5}, ALL),
        # Of large errors, links and pairing are the only cause if they explain the images.
        (99.0, Causes(), {LINKS: 63.9}, {"shift": 0.5, "links": True}, [LINKS]),
        (99.0, Causes(), {LINKS: 64.0, PAIRING: 90.0}, {"shift": 0.5, "links": True}, [PAIRING, *ALL]),
        (99.0, Causes(has_exchanged_links=True), {}, {"links": True}, ALL),
        (100.0, Causes(), {PAIRING: 79.9}, {"shift": 0.5}, [PAIRING]),
        (100.0, Causes(), {PAIRING: 80.0}, {"shift": 0.5}, [PAIRING, *ALL]),
        (100.0, Causes(shift=1.0), {PAIRING: 1.0}, {"shift": 0.5}, ALL),
        # Held poses are the cause if noise is left.
        (99.0, Causes(), {POSES: 1.5}, {"held": True, "shift": 0.5}, [POSES]),
        (99.0, Causes(), {POSES: 1.51}, {"held": True}, ALL),
        (9.0, Causes(), {POSES: 1.5}, {"held": True}, [POSES, *ALL]),
        (99.0, Causes(has_free_poses=True), {POSES: 1.5}, {"held": True}, ALL),
        # What a state contains is not tried again, and the geometry contains the offsets.
        (9.0, Causes(sizes={"b": 1.1}, has_lens=True, has_points=True), {}, {}, [OFFSETS, GEOMETRY]),
        (9.0, Causes(arm=ARM_SETS[OFFSETS]), {}, {}, [SIZE, LENS, CORNERS, GEOMETRY]),
        (9.0, Causes(arm=ARM_SETS[GEOMETRY]), {}, {}, [SIZE, LENS, CORNERS]),
        (9.0, Causes(), {}, {"corners": 151}, [SIZE, LENS, OFFSETS, GEOMETRY]),
        (9.0, Causes(), {}, {"has_joint_values": False}, [SIZE, LENS, CORNERS]),
        # A model without a fit is no cause.
        (9.0, Causes(), {LENS: None}, {}, [SIZE, CORNERS, OFFSETS, GEOMETRY]),
        (99.0, Causes(), {LINKS: None, POSES: None, PAIRING: None},
         {"shift": 1.0, "held": True, "links": True}, ALL),
    ],
)  # fmt: skip
def test_causes_are_tried_in_turn(monkeypatch, pixels, causes, errors, changes, tried):
    given = {"shift": 0.0, "links": False, "held": False, "corners": 150, "has_joint_values": True} | changes
    # The start has values: shifts, links and free poses have other ones.
    anew = (PAIRING, LINKS, POSES)

    def fitted(_, more: Causes, start: Any) -> Any:
        names = {
            LINKS: more.has_exchanged_links != causes.has_exchanged_links,
            POSES: more.has_free_poses != causes.has_free_poses,
            PAIRING: more.shift != causes.shift,
            SIZE: more.sizes != causes.sizes,
            LENS: more.has_lens != causes.has_lens,
            CORNERS: more.has_points != causes.has_points,
            OFFSETS: more.arm != causes.arm == "" and more.arm == ARM_SETS[OFFSETS],
            GEOMETRY: more.arm != causes.arm and more.arm == ARM_SETS[GEOMETRY],
        }
        (name,) = (name for name, is_changed in names.items() if is_changed)
        assert start == (None if name in anew else {"first": 1.0})
        if errors.get(name, pixels) is None:
            raise NotObservableError("too few images")
        return fake_state(errors.get(name, pixels))

    cameras = (SimpleNamespace(width=960, height=1280),)
    rig = SimpleNamespace(has_links_to_exchange=given["links"], cameras=cameras)
    for name, value in {
        "_State": SimpleNamespace(of=fitted),
        "_rig": lambda _: rig,
        "held_entries": lambda *_: ["camera_wrist"] * given["held"],
        "count_corners": lambda _: given["corners"],
        "has_joint_values": lambda _: given["has_joint_values"],
        "find_shift": lambda *_: given["shift"],
        "find_sizes": lambda *_: {"b": 1.02},
    }.items():
        monkeypatch.setattr(diagnosis, name, value)
    state: Any = SimpleNamespace(error=error(pixels), noise=1.0, causes=causes, values={"first": 1.0})
    hand_eye: Any = SimpleNamespace(data=(), known={})
    assert list(diagnosis._try_causes(hand_eye, state)) == tried


@pytest.mark.parametrize(("scale", "is_plausible"), [(1.0, True), (20.0, False)])
def test_errors_of_an_arm_are_about_as_large_as_those_of_manufacturing(scale, is_plausible):
    errors = select_parameters(ARMS["ur10"](), ARM_SETS[GEOMETRY])
    x = scale * errors.priors
    problem = SimpleNamespace(errors=errors, chain=errors.at)
    state: Any = SimpleNamespace(fit=SimpleNamespace(problem=problem, solution=SimpleNamespace(x=x)))
    assert diagnosis._is_plausible(GEOMETRY, state) == is_plausible
    assert diagnosis._is_plausible(LENS, state)


@pytest.mark.parametrize(
    ("n_rejected", "causes", "remaining", "is_whole"),
    [
        (4, (LENS,), 1.5, True),
        (4, (LENS,), 1.51, False),
        (4, (), 1.0, False),
        (3, (LENS,), 1.0, False),
        (4, None, 1.0, False),
    ],
)
def test_rejected_corners_are_examined_if_they_are_many(monkeypatch, n_rejected, causes, remaining, is_whole):
    """They count if a cause explains all corners up to the noise of the others."""
    base, nothing = SimpleNamespace(error=error(8.0), noise=1.0), SimpleNamespace(data=())
    empty = {"causes": (), "alternatives": (), "trials": (), "hand_eye": nothing, "last": None}
    inliers: Any = SimpleNamespace(base=base, noise=2.0, **empty)
    whole: Any = SimpleNamespace(**vars(inliers) | {
        "base": SimpleNamespace(error=error(40.0)), "remaining": remaining, "causes": causes,
    })  # fmt: skip
    searches = {"good": inliers, "all": None if causes is None else whole}
    monkeypatch.setattr(diagnosis, "_search", lambda _, data, *__: searches[data[0]])
    monkeypatch.setattr(diagnosis, "second_rotation", lambda *_: 0.5)
    monkeypatch.setattr(diagnosis, "describe_configurations", lambda _: "joint values")
    weights = np.ones(100)
    weights[:n_rejected] = 0.0
    problem = SimpleNamespace(errors=SimpleNamespace(chain=None))
    good = SimpleNamespace(data=("good",))
    fit: Any = SimpleNamespace(
        data=("all",), weights=(weights,), problem=problem, without_rejected=lambda: good
    )
    found = diagnosis.diagnose_hand_eye(fit, 1e-3, (), False)
    assert found is not None
    assert found.error == (whole if is_whole else inliers).base.error
    # The noise is a share of both figures.
    assert found.noise.pixels == pytest.approx(2.0)
    assert found.noise.distance == pytest.approx(2e-4)
    assert found.noise.n_corners == 99
    # Noise explains no more than the whole error.
    inliers.noise = whole.noise = 99.0
    whole_noise = diagnosis.diagnose_hand_eye(fit, 1e-3, (), False)
    assert whole_noise is not None
    assert whole_noise.noise == whole_noise.error
    assert (found.rotation, found.position_std) == (0.5, 1e-3)


def test_unrelated_images_have_no_diagnosis():
    fit: Any = SimpleNamespace()
    assert HandEyeFit(fit, 1e-3, (), "They do not move alike.", False).diagnosis is None


def test_noise_is_that_within_an_image_and_of_the_fit_of_the_others(state):
    """The error of a left-out image of right ones is their noise and that of the poses."""
    assert state.scatter == pytest.approx(np.sqrt(2) * SIGMA, rel=0.1)
    std = diagnosis.held_out_prediction_std(state.fit, diagnosis.k_fold(state.fit.data, 5))
    assert state.noise == pytest.approx(state.scatter * np.sqrt(1 + std**2))
    assert state.scatter < state.noise < 2 * state.scatter
    assert not state.is_displaced


def test_images_that_are_far_from_the_model_are_wrong_if_all_their_corners_are_rejected(hand_eye, state):
    """All corners of images 0 to 3 are rejected; the limit is five times the error of left-out images."""
    (images,) = hand_eye.data
    names = [f"{number}.png" for number in images.image]
    far = state.error.pixels * np.array([99.0, 6.0, 4.0, 6.0, 99.0, 0.0])[images.image]
    shifted = images.values + np.outer(far, [0.6, 0.8])
    item = images.replace(values=shifted, image_names=np.array(names, object))
    weights = np.where(images.image < 4, 0.0, 1.0)
    weights[np.flatnonzero(images.image == 4)[1:]] = 0.0
    found = diagnosis._wrong_images(hand_eye, state, item, weights)
    assert found == [name for name in dict.fromkeys(names) if name in ("0.png", "1.png", "3.png")]


@pytest.mark.parametrize(
    ("pixels", "lengths", "log_ratio", "is_named"),
    [
        (3.0, [4e-4], 9.0, True),
        # Noise explains two pixels (RMS of two coordinates: 1.41 px), the images share no displacement, or
        # the boards differ by no more than twice the measured lengths.
        (2.1, [1e-4], 9.0, False),
        (2.2, [1e-4], 9.0, True),
        (50.0, [1e-4], 9.0, True),
        (50.1, [1e-4], 9.0, False),
        (3.0, [4e-4], 5.0, False),
        (3.0, [1e-4, 4.45e-4], 9.0, False),
        (3.0, [1e-4, 4.40e-4], 9.0, True),
        (3.0, [], 9.0, False),
    ],
)
def test_images_that_contradict_measured_lengths_are_named(
    monkeypatch, hand_eye, pixels, lengths, log_ratio, is_named
):
    """A board that is 1 mm off, of which noise of 1 px along each axis explains a part."""
    jitter = Jitter(1.0, 1e-3, 1e-3, log_likelihood_ratio=log_ratio)
    monkeypatch.setattr(diagnosis, "residual_jitter", lambda _: jitter)
    groups = {"board": ("m", 1e-3), "pixels": ("px", pixels), "roll": ("rad", 1.0)}
    groups |= {f"length{i}": ("m", length) for i, length in enumerate(lengths)}
    errors: Any = SimpleNamespace(
        groups={name: SimpleNamespace(unit=unit, rms=rms) for name, (unit, rms) in groups.items()}
    )
    fit: Any = SimpleNamespace(data=hand_eye.data)
    text = diagnosis.describe_contradiction(fit, errors)
    assert bool(text) == is_named
    if is_named:
        assert "they leave 1.00 mm at the board" in text
        assert "noise of the corners explains 1.41 px" in text
        assert f"the others leave {diagnosis._mm(max(lengths))}." in text
    del errors.groups["board"]
    assert diagnosis.describe_contradiction(fit, errors) == ""


@pytest.mark.parametrize(
    ("shift", "has_joint_values", "text", "remedy"),
    [
        (
            -1.0,
            True,
            "joint values one row before its own",
            "table of joint values, or add --mend rows:below.",
        ),
        (
            1.04,
            True,
            "joint values one row after its own",
            "table of joint values, or add --mend rows:above.",
        ),
        (-2.0, False, "flange poses 2 rows before its own", "table of flange poses."),
        (1.06, True, "joint values 1.1 rows after its own, a time offset", "Synchronize"),
        (-0.52, True, "joint values 0.52 rows before its own, a time offset", "Synchronize"),
        (0.04, True, "joint values 0.04 rows after its own, a time offset", "Synchronize"),
    ],
)
def test_a_shift_is_described_by_rows(hand_eye, shift, has_joint_values, text, remedy):
    data = tuple(item.replace(has_joint_values=has_joint_values) for item in hand_eye.data)
    state: Any = SimpleNamespace(causes=Causes(shift=shift))
    found, what_to_do = diagnosis._pairing_text(replace(hand_eye, data=data), state)
    assert text in found
    assert remedy in what_to_do


@pytest.mark.parametrize(
    ("sizes", "square", "text"),
    [
        ({"a": 1.03, "b": 0.96}, 0.03, "board 'b', 4 % smaller than stated: squares of 28.8 mm, not 30 mm"),
        ({"a": 1.05, "b": 0.96}, 0.02, "board 'a', 5 % larger than stated: squares of 21 mm, not 20 mm"),
        ({"b": 1.05}, 0.0, "board 'b', 5 % larger than stated"),
    ],
)
def test_the_board_whose_size_differs_most_is_described(monkeypatch, sizes, square, text):
    rig = SimpleNamespace(boards=[SimpleNamespace(name=name, square=square) for name in "ab"])
    monkeypatch.setattr(diagnosis, "_rig", lambda _: rig)
    state: Any = SimpleNamespace(causes=Causes(sizes=sizes))
    hand_eye: Any = SimpleNamespace(data=())
    assert diagnosis._size_text(hand_eye, state)[0] == f"the size of {text}"


@pytest.mark.parametrize(("axis", "is_flat"), [(2, False), (0, True)])
def test_the_displacement_of_corners_is_that_beside_a_rigid_motion(hand_eye, axis, is_flat):
    (images,) = hand_eye.data
    item = models._with_rig(Causes(has_points=True), images)
    stated = images.rig.boards[0].points
    seen = np.unique(images.corner)
    moved = stated.copy()
    moved[:, axis] += np.random.default_rng(0).choice([-1e-3, 1e-3], len(stated))
    # Corners that no image shows do not count.
    moved[np.setdiff1d(np.arange(len(stated)), seen)] += 1.0
    values = {p.name: p.nominal for p in item.instrument_parameters}
    values |= {f"board_board0.p{k}{c}": moved[k, i] for k in range(len(stated)) for i, c in enumerate("xyz")}
    fit = SimpleNamespace(data=(item,))
    state: Any = SimpleNamespace(fit=fit, values=values)
    text, _ = diagnosis._corner_text(hand_eye, state)
    found, wanted = (each[seen] - each[seen].mean(0) for each in (moved, stated))
    rms = Rotation.align_vectors(wanted, found)[1] / np.sqrt(len(seen))
    assert f"the corners of board 'board0', {diagnosis._mm(rms)} (RMS) beside the stated places" in text
    assert ("not flat" in text) != is_flat


@pytest.mark.parametrize(
    ("pixels", "has_joint_values", "text", "remedy"),
    [
        (
            50.0,
            True,
            "errors of the arm of another kind (deflection",
            "Check the joint values of the images, and",
        ),
        (50.0, False, "errors of the arm (deflection", "Check the flange poses of the images, and"),
        (50.1, True, "wrong joint values: no deflection", "zeros of the joints, and whether the robot file"),
        (
            50.1,
            False,
            "wrong flange poses: no deflection",
            "notation and order of the rotations, and the image",
        ),
    ],
)
def test_displaced_images_are_described_by_their_size(hand_eye, pixels, has_joint_values, text, remedy):
    data = tuple(item.replace(has_joint_values=has_joint_values) for item in hand_eye.data)
    found = diagnosis._displacement(replace(hand_eye, data=data), fake_state(pixels))
    assert found.cause == DISPLACEMENT
    assert text in found.text
    assert remedy in found.remedy
    assert found.error == error(pixels)


def test_exchanged_links_are_described(hand_eye):
    state: Any = SimpleNamespace(values={}, fit=SimpleNamespace(data=hand_eye.data))
    text, remedy = diagnosis._links_text(hand_eye, state)
    assert (
        text
        == "the links: camera 'camera0' on link 'world' and board 'board0' on link 'tip' explain the images"
    )
    assert remedy == "Exchange the links in the rig file."


def test_the_cause_is_followed_by_what_remains_and_by_what_to_do():
    arm, lens, moved = (
        trial(name, pixels) for name, pixels in ((GEOMETRY, 4.0), (LENS, 0.6), (DISPLACEMENT, 0.6))
    )
    found = diagnosed(causes=(arm, lens), alternatives=(trial(SIZE, 4.1),))
    assert found.likely == (
        " Likely cause: the arm geometry. If that is estimated, too, 0.40 mm remain."
        " In addition: the lens. If that is estimated, too, 0.060 mm remain."
        " Not distinguishable from: the board size (0.41 mm). Check the lens. Check the arm geometry."
    )
    found = diagnosed(causes=(moved, replace(moved, cause=LENS)))
    assert found.likely.count("Check the displaced images.") == 1
    assert found.likely.count("remain.") == 1


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ((), None),
        (
            ("a.png",),
            "One image does not fit the others and is left out (a.png): check the joint values in its",
        ),
        (
            ("a.png", ""),
            "2 images do not fit the others and are left out (a.png and 1 more): check the joint",
        ),
    ],
)
def test_images_that_are_left_out_are_counted(wrong, text):
    found = diagnosed(wrong=wrong)
    assert [each[: len(text or "")] for each in found.wrong_image_sentences] == ([text] if text else [])
    assert found.image_sentences == found.wrong_image_sentences
    assert found.to_dict()["wrong_images"] == len(wrong)
    assert found.to_dict()["wrong_image_names"] == [name for name in wrong if name]


def test_too_few_rotations_are_stated_before_images_that_are_left_out():
    found = diagnosed(wrong=("a.png",), rotation=np.deg2rad(7.9))
    assert [text[:9] for text in found.image_sentences] == ["Too few r", "One image"]
    assert not diagnosed(rotation=np.deg2rad(8.1)).has_few_rotations
    # An error of 1 mm divided by the rotation, which is not zero.
    assert "by up to 1e+03 mm" in diagnosed(rotation=1e-3).rotation_sentences[0]
    assert "by metres" in diagnosed(rotation=1e-4).rotation_sentences[0]


def test_the_document_and_the_table_have_all_trials():
    trials = trial(LENS, 2.0), trial(SIZE, 0.6)
    found = diagnosed(causes=trials, alternatives=trials[1:])
    document = found.to_dict()
    assert document["error"] == {"residual_rms_px": 9.0, "board_rms_m": 9e-4, "corners": 99}
    assert document["noise"]["residual_rms_px"] == 0.5
    assert document["causes"][0] == {
        "cause": "lens", "residual_rms_px": 2.0, "board_rms_m": 2e-4, "text": "the lens",
        "remedy": "Check the lens.",
    }  # fmt: skip
    assert document["alternatives"] == ["board size"]
    assert len(document["trials"]) == 2
    assert (document["second_rotation_rad"], document["position_std_m"]) == (1.0, 1e-3)
    assert document["is_noise"] is False
    assert document["text"] == found.error_sentence + found.likely
    assert found.table.texts == [
        ["poses only", "9.0 px", "0.90 mm"],
        ["noise of the corners", "0.50 px", "0.050 mm"],
        ["board size, too", "0.60 px", "0.060 mm"],
        ["lens, too", "2.00 px", "0.200 mm"],
    ]
    small = diagnosed(pixels=0.75, causes=trials)
    assert small.is_noise
    assert small.to_dict()["text"] == small.error_sentence


def test_errors_behind_a_camera_are_stated_in_pixels():
    found = replace(diagnosed(), error=ImageError(60.0, np.inf, 99))
    assert found.error_sentence == "Error of left-out images: 60 px."
    assert replace(found, error=ImageError(50.0, 10.1, 99)).error_sentence == (
        "Error of left-out images: more than 10 m at the board (50 px); noise of the corners explains "
        "0.050 mm (0.50 px)."
    )


@pytest.mark.parametrize(("n_images", "is_searched"), [(4, False), (5, True)])
def test_causes_of_five_configurations_are_searched(monkeypatch, hand_eye, state, n_images, is_searched):
    monkeypatch.setattr(diagnosis._State, "of", lambda *_: state)
    monkeypatch.setattr(diagnosis, "_find_causes", lambda *_: ((), (), (), state))
    (images,) = hand_eye.data
    data = images.take(images.image < n_images), images.take(images.image < 0)
    found = diagnosis._search(state.fit, data, (images,), False)
    assert (found is not None) == is_searched
    problem, weights = state.fit.problem.with_data(data[:1]), (np.ones(len(data[0].rows)),)
    fit = replace(state.fit, data=data[:1], problem=problem, weights=weights)
    assert (diagnosis.diagnose_hand_eye(fit, 1e-3, (), False) is not None) == is_searched
    if found is not None:
        # Measurements without samples are left out, and held-out images have a place in the sequence.
        (item,) = found.hand_eye.data
        assert len(item.rows) == len(data[0].rows)
        assert len(found.hand_eye.sequence) == 6


def test_causes_are_searched_in_configurations_over_the_whole_range(monkeypatch, hand_eye, state):
    monkeypatch.setattr(diagnosis._State, "of", lambda *_: state)
    monkeypatch.setattr(diagnosis, "_find_causes", lambda *_: ((), (), (), state))
    monkeypatch.setattr(diagnosis, "_n_examined", lambda count, n_corners: count // 2)
    (images,) = (item.replace(has_stated_sigma=True) for item in hand_eye.data)
    label = images.configuration_groups
    parts = images.take(label < 2), images.take((label > 1) & (label < 5)), images.take(label == 5)
    found = diagnosis._search(state.fit, parts, (), False)
    assert found is not None
    assert not any(item.has_stated_sigma for item in found.hand_eye.data)
    used = np.unique(np.concatenate([item.q for item in found.hand_eye.data]), axis=0)
    q = images.q[np.unique(label, return_index=True)[1]]
    places = [int(np.flatnonzero((q == each).all(1))[0]) for each in used]
    assert len(places) == 3
    assert {0, 5} <= set(places)


@pytest.mark.parametrize(("ratio", "is_long"), [(2.99, False), (3.01, True)])
def test_an_error_by_a_step_that_is_too_long_is_that_of_the_fitted_images(
    monkeypatch, hand_eye, state, ratio, is_long
):
    fitted = diagnosis.fitted_error(state.fit)
    start = replace(state, error=error(ratio * fitted.pixels), noise=0.3, scatter=0.2)
    monkeypatch.setattr(diagnosis._State, "of", lambda *_: start)
    monkeypatch.setattr(diagnosis, "_find_causes", lambda *_: ((), (), (), start))
    found = diagnosis._search(state.fit, hand_eye.data, (), True)
    assert found is not None
    assert found.base.error == (fitted if is_long else start.error)
    assert found.base.noise == (0.2 if is_long else 0.3)
    assert found.hand_eye.is_arm_tried


def test_inverse_flange_poses_show_the_same_images_as_exchanged_links(hand_eye, state):
    """Each pose is stated relative to the link that carries it in one of both explanations."""
    (images,) = hand_eye.data
    rig = images.rig
    link = np.eye(4)
    link[:3, 3] = 0.1, 0.0, 0.3
    rig = replace(rig, camera_mounts=(replace(rig.camera_mounts[0], link_pose=link),))
    item = images.replace(rig=rig, has_joint_values=False)
    known = replace(state, fit=replace(state.fit, data=(item,)))
    text, remedy = diagnosis._links_text(replace(hand_eye, data=(item,)), known)
    values = state.values
    camera, board = (
        np.array([values[f"{entry}.{axis}"] for axis in "xyz"])
        for entry in ("camera_camera0", "board_board0")
    )

    def length(vector: np.ndarray) -> str:
        size = float(np.linalg.norm(vector))
        return format_quantity(size, "m", 0.03 * size)

    offset = link[:3, 3]
    stated, exchanged = (
        f"camera 'camera0' is {length(first)} from link {one!r}, and board 'board0' {length(second)} from "
        f"link {other!r}"
        for first, one, second, other in (
            (camera, "tip", board, "world"),
            (camera + offset, "world", board - offset, "tip"),
        )
    )
    assert f"If the poses are inverse, {stated}; if the links are exchanged, {exchanged}" in text
    assert remedy.startswith(
        "If camera 'camera0' is on link 'tip', invert the poses, or add --mend poses:inverse"
    )


@pytest.mark.parametrize(
    ("inverse", "moved", "start", "end"),
    [
        ([], {"camera": 0.005, "board": 0.2}, "the stated pose of board 'board0' is 200", "Or add board to"),
        (["camera"], {"board": 9.0}, "the stated pose of camera 'camera0' is inverse", "Or add camera to"),
        (
            ["camera", "board"],
            {},
            "the stated pose of camera 'camera0' is inverse",
            "Or add camera and board to",
        ),
    ],
)
def test_held_poses_that_are_inverse_or_differ_most_are_described(inverse, moved, start, end):
    images = faulty_setup("ur10", "nothing", 27, is_on_wrist=True, n_images=2)[2].exact
    values = {p.name: p.nominal for p in images.instrument_parameters}
    poses = {"camera": images.rig.cameras[0].pose, "board": images.rig.boards[0].pose}
    for kind, pose in poses.items():
        assert pose is not None
        found = np.linalg.inv(pose) if kind in inverse else pose
        vector = [*found[:3, 3], *se3.log3(found[:3, :3])]
        values |= dict(
            zip([f"{kind}_{kind}0.{n}" for n in ("x", "y", "z", "rx", "ry", "rz")], vector, strict=True)
        )
    for kind, size in moved.items():
        values[f"{kind}_{kind}0.x"] += size
    hand_eye: Any = SimpleNamespace(data=(images,), known=images.stated_values)
    state: Any = SimpleNamespace(values=values)
    text, remedy = diagnosis._poses_text(hand_eye, state)
    assert text.startswith(start)
    assert text.count("is inverse") == len(inverse)
    assert remedy.endswith(f"{end} --parameters.")


@pytest.mark.parametrize("name", ["pairing", "stated poses", "board size"])
def test_a_trial_has_the_text_of_its_cause(monkeypatch, name):
    function = {"pairing": "_pairing_text", "stated poses": "_poses_text", "board size": "_size_text"}[name]
    monkeypatch.setattr(diagnosis, function, lambda *_: ("what", "do"))
    hand_eye: Any = SimpleNamespace()
    assert diagnosis._trial(hand_eye, name, fake_state(2.0)) == Trial(name, error(2.0), "what", "do")


def test_the_board_whose_corners_are_displaced_most_is_described():
    """Two corners of a board show no displacement beside a rigid motion."""
    chain, rng = ARMS["ur10"](), np.random.default_rng(1)
    images = simulate(chain, chain, rng, is_on_wrist=False, n_images=6, sigma=0.2, n_boards=2).images
    few = images.take((images.board == 0) | (images.corner == images.corner[images.board == 1][0]))
    for item, name, sizes in (
        (images, "board1", (1e-3, 2e-3)),
        (images, "board0", (2e-3, 1e-3)),
        (few, "board0", (1e-3, 2e-3)),
    ):
        item = models._with_rig(Causes(has_points=True), item)
        values = {p.name: p.nominal for p in item.instrument_parameters}
        for number, board in enumerate(images.rig.boards):
            for k in range(len(board.points)):
                values[f"board_board{number}.p{k}x"] += sizes[number] * rng.choice([-1, 1])
        state: Any = SimpleNamespace(fit=SimpleNamespace(data=(item,)), values=values)
        hand_eye: Any = SimpleNamespace(data=(item,))
        text, _ = diagnosis._corner_text(hand_eye, state)
        assert f"the corners of board {name!r}, " in text
        size = float(text.split(", ")[1].split(" mm")[0])
        assert size == pytest.approx(1e3 * sizes[int(name[-1])], rel=0.15)


@pytest.mark.parametrize(
    ("factors", "text"),
    [
        ((1.1, 1.1, 1.0, 1.0), "the lens, above all fx, fy of camera 'c': 1100, 1111 px, not 1000, 1010 px"),
        ((1.0, 1.0, 1.1, 1.0), "the lens, above all cx, cy of camera 'c': 704, 480 px, not 640, 480 px"),
        ((0.5, 0.5, 0.5, 0.5), "the resolution: "),
        ((-1.0, 1.0, 1.0, 1.0), "the lens"),
    ],
)
def test_the_change_of_a_lens_is_described_by_its_values(hand_eye, factors, text):
    (images,) = hand_eye.data
    stated = np.r_[1000.0, 1010.0, 640.0, 480.0, np.zeros(5)]
    camera = replace(images.rig.cameras[0], name="c", values=stated)
    item = images.with_rig(replace(images.rig, cameras=(camera,)))
    values = dict(zip([f"camera_c.{n}" for n in ("fx", "fy", "cx", "cy")], stated[:4] * factors, strict=True))
    state: Any = SimpleNamespace(values=values)
    found, _ = diagnosis._lens_text(replace(hand_eye, data=(item,)), state)
    assert found == text or (text.endswith(": ") and found.startswith(text) and "(camera 'c')" in found)
