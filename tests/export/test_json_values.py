"""No document holds a number that is not one."""

import json
import math

from orthoswarm.export.json_values import finite, json_text


def test_what_is_no_number_is_null():
    text = json_text({"a": math.inf, "b": [1.5, math.nan, {"c": -math.inf}], "d": (2, True, None, "NaN")})
    assert json.loads(text, parse_constant=lambda name: 1 / 0) == {
        "a": None,
        "b": [1.5, None, {"c": None}],
        "d": [2, True, None, "NaN"],
    }
    assert json_text({"ä": 1}) == '{"ä": 1}'


def test_no_number_stays_none():
    assert [finite(value) for value in (None, math.nan, math.inf, 2)] == [None, None, None, 2.0]
