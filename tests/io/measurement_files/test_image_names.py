"""The column `image`: it names the images for people, and changes nothing else."""

import pickle

import numpy as np
import pytest
from robots import write

from dhcal_pin.exceptions import InvalidArgumentError
from dhcal_pin.io import measurement_text, read_measurement_file, read_measurements
from dhcal_pin.measurements import KINDS, CameraCorners, Noise
from dhcal_pin.measurements.base import concatenate


@pytest.fixture(scope="module")
def images(sim_6dof):
    """Eight configurations, each in the image of one of two cameras, without names."""
    rng = np.random.default_rng(3)
    data = CameraCorners.simulate(sim_6dof, rng.uniform(-2.5, 2.5, (8, 6)), Noise(1e-3), rng)
    assert data.n_images == 8
    return data


def read_named(path, chain, images, names):
    """Read images from a file with names; return them with the notes on the file."""
    lines = measurement_text(images, chain).splitlines()
    text = [f"{lines[0]},image", *(f"{line},{name}" for line, name in zip(lines[1:], names, strict=True))]
    file = read_measurement_file(write(path, "corners.csv", "\n".join(text)), chain, rig=images.rig)
    return file.data, file.notes


def true_names(images):
    """Return a name for each sample, from the first joint value of its configuration."""
    return [f"pose{1000 * q[0]:.0f}.png" for q in images.q]


def label_of(images, sample):
    """Return the label of the image of a sample."""
    return images.image_labels[images.image[sample]]


def test_the_names_belong_to_the_samples_in_any_order_of_the_rows(tmp_path, sim_6dof, images):
    order = np.random.default_rng(0).permutation(len(images.rows))
    mixed = images.take(order)
    data, notes = read_named(tmp_path, sim_6dof, mixed, true_names(mixed))
    assert not notes
    for item in (
        data,
        data.take(data.image != 3),
        concatenate([data.take(slice(0, 9)), data.take(slice(9, None))]),
    ):
        assert [label_of(item, i) for i in range(len(item.rows))] == true_names(item)
    again = pickle.loads(pickle.dumps(data))
    assert again.image_labels == data.image_labels


def test_names_do_not_change_what_an_image_is(tmp_path, sim_6dof, images):
    """Two photographs of one configuration are one image with both names."""
    names = ["same.png"] * len(images.rows)
    of_first = np.flatnonzero(images.image == images.image[0])
    names[of_first[-1]] = "other.png"
    data, _ = read_named(tmp_path, sim_6dof, images, names)
    np.testing.assert_array_equal(data.image, images.image)
    assert label_of(data, 0) == "same.png + other.png"
    assert sorted(data.image_labels) == [*["same.png"] * 7, "same.png + other.png"]


def test_names_may_be_missing(tmp_path, sim_6dof, images):
    names, last = true_names(images), images.image[-1]
    some = [name if number != last else "" for name, number in zip(names, images.image, strict=True)]
    data, _ = read_named(tmp_path, sim_6dof, images, some)
    assert label_of(data, -1) == ""
    assert label_of(data, 0) == names[0]
    assert images.image_labels == ("",) * 8
    assert "image" not in images.to_columns()


def test_names_are_written_as_they_were_read(tmp_path, sim_6dof, images):
    names = true_names(images)
    data, _ = read_named(tmp_path, sim_6dof, images, names)
    path = write(tmp_path, "again.csv", measurement_text(data, sim_6dof))
    assert read_measurements(path, sim_6dof, rig=images.rig).image_names.tolist() == names


def test_names_cannot_control_the_terminal(tmp_path, sim_6dof, images):
    names = ["a\x1b[31m" + "b" * 90 + ".png"] * len(images.rows)
    data, _ = read_named(tmp_path, sim_6dof, images, names)
    for label in data.image_labels:
        assert label.isprintable()
        assert len(label) == 60
        assert label.endswith("b.png")


def test_python_takes_names_too(images):
    cameras = [images.rig.cameras[i].name for i in images.camera]
    arguments = (images.q, images.values, images.corner, images.rig, cameras)
    data = CameraCorners(*arguments, image_names=true_names(images))
    assert label_of(data, 5) == true_names(images)[5]
    with pytest.raises(InvalidArgumentError, match="image_names has 1 names"):
        CameraCorners(*arguments, image_names=["a"])


def test_files_of_other_kinds_may_have_the_column(tmp_path, sim_6dof):
    """Poses from images keep their kind, whether the names are texts or numbers."""
    q = np.random.default_rng(0).uniform(-2, 2, (3, 6))
    data = KINDS["pose"].simulate(sim_6dof, q, Noise(), np.random.default_rng(0))
    lines = measurement_text(data, sim_6dof).splitlines()
    for names in (("image", "1.png", "", "3.png"), ("image", "1", "2", "3")):
        text = "\n".join(f"{line},{name}" for line, name in zip(lines, names, strict=True))
        assert read_measurements(write(tmp_path, "poses.csv", text), sim_6dof).kind == "pose"
