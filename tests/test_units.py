"""Units of options."""

import numpy as np
import pytest

from dhcal_pin.exceptions import DhcalError
from dhcal_pin.units import parse_noise


@pytest.mark.parametrize(
    ("text", "metres", "radians"),
    [
        ("0.1mm", 1e-4, 0.0),
        ("0.1 mm , 0.01deg", 1e-4, 0.01 * np.pi / 180),
        ("2mrad,50um", 5e-5, 2e-3),
        ("5µm", 5e-6, 0.0),
        ("0mm", 0.0, 0.0),
    ],
)
def test_parse_noise(text, metres, radians):
    assert parse_noise(text) == pytest.approx((metres, radians), rel=1e-15, abs=0)


@pytest.mark.parametrize("text", ["", "0.1", "mm", "0.1inch", "-1mm", "1-2mm", "nanmm", "1e999mm", "1mm,2um"])
def test_invalid_noise_is_an_error(text):
    with pytest.raises(DhcalError, match="noise"):
        parse_noise(text)
