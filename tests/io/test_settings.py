"""Settings: priors, bounds and payloads."""

import math

import pytest
from robots import write

from dhcal_pin.exceptions import DhcalError, FileFormatError, InvalidArgumentError
from dhcal_pin.io import parse_payload, read_bounds, read_priors
from dhcal_pin.robot import Payload


def test_priors_by_name(tmp_path):
    path = write(tmp_path, "p.toml", 'd1 = 0.002\n"theta*" = 1\n')
    assert read_priors(str(path)) == {"d1": 0.002, "theta*": 1.0}
    assert (read_priors(None), read_priors("none"), read_priors("default")) == (None, "none", "default")


def test_bounds_by_name_may_be_infinite(tmp_path):
    path = write(tmp_path, "b.toml", '"d*" = [0, inf]\na1 = [-0.5, 0.5]\n')
    assert read_bounds(path) == {"d*": (0.0, math.inf), "a1": (-0.5, 0.5)}
    assert read_bounds(None) == {}


@pytest.mark.parametrize("text", ["a1 = 1", "a1 = [2, 1]", "a1 = [1, nan]", "a1 = [1]", "a1 = [true, 2]"])
def test_invalid_bounds_are_an_error(tmp_path, text):
    with pytest.raises(FileFormatError, match=r"b\.toml: a1 = .*least and the largest value in m or rad"):
        read_bounds(write(tmp_path, "b.toml", text))


def test_payloads():
    assert parse_payload("5kg") == Payload(5.0)
    assert parse_payload("2.5kg @ 0, -10, 80mm") == Payload(2.5, (0.0, -0.01, 0.08))
    assert parse_payload("1e1kg@.1,0,0m") == Payload(10.0, (0.1, 0.0, 0.0))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("5", "5kg or 5kg@0,0,80mm"),
        ("5lb", "5kg or 5kg@0,0,80mm"),
        ("0kg", "must be positive"),
        ("5kg@0,0,800m", "within 100 m"),
    ],
)
def test_invalid_payloads_are_an_error(text, words):
    with pytest.raises(InvalidArgumentError, match=words):
        parse_payload(text)


def test_an_unknown_choice_of_priors_is_an_error():
    with pytest.raises(DhcalError, match="expected default, none, or a file"):
        read_priors("nowhere.toml")
