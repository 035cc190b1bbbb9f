"""Two stations, remote controls and failsafes act at once: our station keeps its rules in every order of events."""

import pytest

from tests.vehicles.safety.station_rules import Rules
from tests.vehicles.safety.two_stations import Field


def judged(seed):
    field = Field(seed)
    try:
        field.prepare()
        rules = Rules(field)
        field.run(rules.look)
    finally:
        field.fleet.close()
    return rules, field


@pytest.mark.parametrize("seed", range(60))
def test_our_station_keeps_its_rules(seed):
    rules, field = judged(seed)
    assert not rules.broken, "\n".join([*rules.broken, *field.log])
