"""JSON documents."""

import json
import os

from dhcal_pin.report.json_document import json_text


def test_json_has_no_nan_and_any_file_name():
    text = json_text({"a": [float("nan"), -float("inf"), 1.5], "name": os.fsdecode(b"\xff.csv"), "°": True})

    def never(name):
        raise AssertionError(name)

    content = json.loads(text.encode(), parse_constant=never)
    assert content == {"a": [None, None, 1.5], "name": "\udcff.csv", "°": True}
