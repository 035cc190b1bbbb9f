"""Two stations, remote controls and failsafes act at once: our station keeps its rules in every order of events.

1. Nothing is armed unless its mode, place and mission were read in the last second, and are those of its start.
2. Nothing is started, or told to go on, after somebody stopped it, as soon as that was told or is over a second old.
3. What a vehicle is said to do is what it does, up to some seconds after a change.
4. Complete is a mission whose places were flown over.
5. Of a plan nobody is started before those who are to be in the air before have climbed.

A seed makes a day: vehicles, links, and what everybody does when. `judged(seed)` plays it, and its log tells it.
"""

import math
from dataclasses import replace
from functools import cache

import pytest

from gcs_plugin.fleet.flight_state import Word, flight_state
from gcs_plugin.fleet.separation.takeoff_schedule import TakeoffSchedule
from gcs_plugin.mission.flown_items import FlownItems
from gcs_plugin.mission.start_dialogue import LastLook
from tests.vehicles.safety import station_rules
from tests.vehicles.safety.station_rules import Rules
from tests.vehicles.safety.two_stations import Field

USUAL, BLOCKS, BLOCK = 60, 20, 75


def judged(seed):
    field = Field(seed)
    try:
        field.prepare()
        rules = Rules(field)
        field.run(rules.look)
    finally:
        field.fleet.close()
    return rules, field


@cache
def usual(seed):
    """Rules that were broken on a day, how often each was judged, and the day's log."""
    rules, field = judged(seed)
    return rules.broken, rules.judged, field.log


@pytest.mark.parametrize("seed", range(USUAL))
def test_the_station_keeps_its_rules_whatever_others_do(seed):
    broken, _, log = usual(seed)
    assert not broken, "\n".join([*broken, *log])


@pytest.mark.slow
@pytest.mark.parametrize("block", range(BLOCKS))
def test_the_station_keeps_its_rules_on_very_many_days(block):
    first = USUAL + block * BLOCK
    broken = {seed: rules.broken for seed in range(first, first + BLOCK) if (rules := judged(seed)[0]).broken}
    assert not broken


def test_all_rules_are_put_to_the_test():
    judgements = [usual(seed)[1] for seed in range(10)]
    least = {"1": 10, "2": 20, "3": 2000, "4": 3, "5": 10}
    assert all(sum(each[rule] for each in judgements) >= number for rule, number in least.items())


def broken_rules(enough, first=0):
    """Which rules are broken on one of sixty days, until there are enough of them; the first day mostly does."""
    found = set()
    for seed in range(first, first + 60):
        found |= {text.partition("rule ")[2][:1] for text in judged(seed)[0].broken}
        if enough <= found:
            break
    return found


def test_a_station_that_does_not_look_is_found_out(monkeypatch):
    def believes(look, now):
        look._end(True, "it will be as it was")
        return []

    monkeypatch.setattr(LastLook, "start", believes)
    monkeypatch.setattr(LastLook, "seen_s", math.inf)
    assert "1" in broken_rules({"1"})


def test_a_plan_that_does_not_wait_for_those_before_is_found_out(monkeypatch):
    def due(schedule, now):
        ready = [system for system, at in schedule.waiting.items() if at <= now]
        return [system for system in ready if schedule.waiting.pop(system) is not None]

    monkeypatch.setattr(TakeoffSchedule, "due", due)
    assert "5" in broken_rules({"5"}, first=12)


def test_a_word_that_comes_from_the_mode_alone_is_found_out(monkeypatch):
    def by_mode(known):
        state = flight_state(known)
        return replace(state, word=Word.PAUSED) if state.word in (Word.DESCENDING, Word.FLYING) else state

    monkeypatch.setattr(station_rules, "flight_state", by_mode)
    assert "3" in broken_rules({"3"}, first=15)


def test_an_end_that_is_believed_is_found_out(monkeypatch):
    monkeypatch.setattr(FlownItems, "all_reached", True)
    assert "4" in broken_rules({"4"}, first=10)
