"""One pilot has a vehicle at a time."""

import pytest

from gcs_plugin.daemon.store.daemon_events import Events, Told
from gcs_plugin.daemon.store.journal import Journal
from gcs_plugin.daemon.store.people_rows import GONE_S, OPERATOR, People, Person, Pilots
from orthoswarm.model.errors import InputError, OrthoSwarmError


class Post:
    """A command post with two pilots, a clock, and what pages were told."""

    def __init__(self, path):
        self.now, self.told = 0.0, []
        self.journal = Journal(path / "journal.db")
        events = Events()
        events.on(Told, lambda event: self.told.append(event) if event.page == "holds" else None)
        self.people = People(self.journal, events, clock=lambda: self.now)
        self.pilots = Pilots(self.people, events, self.journal)
        if self.people.rows():  # after a restart
            return
        self.anna, self.ben = self.joined("Anna"), self.joined("Ben")

    def joined(self, name) -> Person:
        _, secret = self.people.invite(name, "pilot")
        joined = self.people.join(secret)
        assert joined is not None
        self.people.seen(joined[0])
        return joined[0]


@pytest.fixture
def post(tmp_path):
    post = Post(tmp_path)
    yield post
    post.journal.close()


def test_the_first_who_commands_a_vehicle_has_it(post):
    assert post.pilots.claim(post.anna, ["v1", "v2"]) == {}
    refused = post.pilots.claim(post.ben, ["v2", "v3"])
    assert list(refused) == ["v2"] and "Anna has v2" in refused["v2"]
    assert {row["vehicle"]: row["pilot"]["name"] for row in post.pilots.rows()} == {
        "v1": "Anna", "v2": "Anna", "v3": "Ben",
    }  # fmt: skip
    assert post.pilots.claim(post.anna, ["v1"]) == {}
    assert len(post.told) == 2  # nothing has changed by the last


def test_a_plan_takes_all_its_vehicles_or_none(post):
    post.pilots.claim(post.anna, ["v2"])
    with pytest.raises(OrthoSwarmError, match="Anna has v2"):
        post.pilots.claim(post.ben, ["v1", "v2", "v3"], whole=True)
    assert [row["vehicle"] for row in post.pilots.rows()] == ["v2"]


def test_a_vehicle_is_handed_over_by_its_pilot(post):
    post.pilots.claim(post.anna, ["v1"])
    assert not post.pilots.change(post.ben, "v1", "take")
    assert post.pilots.rows()[0]["asked"] == {"id": post.ben.id, "name": "Ben"}
    assert post.pilots.change(post.anna, "v1", "keep")
    assert post.pilots.rows()[0]["asked"] is None
    with pytest.raises(OrthoSwarmError, match="nobody asks"):
        post.pilots.change(post.anna, "v1", "give")
    post.pilots.change(post.ben, "v1", "take")
    assert not post.pilots.change(post.anna, "v1", "give")
    assert "Ben has v1" in post.pilots.claim(post.anna, ["v1"])["v1"]
    for act in ("give", "keep", "free"):
        with pytest.raises(OrthoSwarmError, match="take it first"):
            post.pilots.change(post.anna, "v1", act)
    with pytest.raises(InputError):
        post.pilots.change(post.ben, "v1", "steal")


def test_a_vehicle_is_free_once_its_pilot_gives_it_up_or_is_gone(post):
    post.pilots.claim(post.anna, ["v1", "v2"])
    post.pilots.change(post.anna, "v1", "free")
    assert post.pilots.change(post.ben, "v1", "take")
    post.now += GONE_S - 1.0
    post.people.seen(post.ben)
    assert post.pilots.claim(post.ben, ["v2"])
    post.now += 2.0  # Anna's page has not been heard for longer than GONE_S
    assert post.pilots.claim(post.ben, ["v2"]) == {}
    assert {row["pilot"]["name"] for row in post.pilots.rows()} == {"Ben"}


def test_who_is_revoked_has_no_vehicle(post):
    post.pilots.claim(post.anna, ["v1"])
    post.pilots.change(post.ben, "v1", "take")
    post.people.revoke(post.ben.id)
    with pytest.raises(OrthoSwarmError, match="nobody asks"):
        post.pilots.change(post.anna, "v1", "give")
    post.people.revoke(post.anna.id)
    assert post.pilots.rows() == []
    post.people.seen(OPERATOR)
    assert post.pilots.claim(OPERATOR, ["v1"]) == {}


def test_there_are_several_pilots_while_somebody_besides_the_operator_can_fly(post):
    assert post.people.has_several_pilots
    for person in (post.anna, post.ben):
        post.people.revoke(person.id)
    assert not post.people.has_several_pilots
    _, secret = post.people.invite("Vera", "viewer")
    post.people.join(secret)
    assert not post.people.has_several_pilots


def test_people_and_their_sessions_survive_a_restart(post, tmp_path):
    _, invitation = post.people.invite("Cora", "analyst")
    joined = post.people.join(invitation)
    assert joined is not None
    again = People(post.journal, Events())
    assert again.of_session(joined[1]) == joined[0]
    assert again.find(joined[0].id) == joined[0]
    assert again.join(invitation) is None


def test_pilots_keep_their_vehicles_over_a_restart(post, tmp_path):
    post.pilots.claim(post.anna, ["v1", "v2"])
    post.pilots.change(post.anna, "v2", "free")
    post.journal.close()
    again = Post(tmp_path)
    assert [(row["vehicle"], row["pilot"]["name"]) for row in again.pilots.rows()] == [("v1", "Anna")]
    assert "Anna has v1" in again.pilots.claim(post.ben, ["v1"])["v1"]
    again.now += GONE_S + 1.0  # her page did not come back
    assert again.pilots.claim(post.ben, ["v1"]) == {}
    again.journal.close()


def test_an_invitation_that_nobody_opened_in_a_day_is_void(post, monkeypatch):
    import time

    number, invitation = post.people.invite("Dora", "viewer")
    later = time.time() + 25 * 3600
    monkeypatch.setattr("gcs_plugin.daemon.store.people_rows.time.time", lambda: later)
    assert post.people.join(invitation) is None
    assert {row["id"]: row["state"] for row in post.people.rows()}[number] == "expired"
