"""The words of the MAVProxy module, against a daemon that answers as its API says."""

from gcs_plugin.mavproxy.daemon_client import Commands


class Answers:
    """A daemon that has two vehicles and takes every command."""

    def __init__(self):
        self.asked = []
        self.rows = [{"id": "v1", "system": 1}, {"id": "falcon", "system": 2}]

    def ask(self, path, body=None):
        self.asked.append(path)
        done = {"outcome": "done", "reason": "done"}
        return (
            self.rows if path == "/api/vehicles" else done | {"results": [{"reason": "v1 holds"}, {"reason": "done"}]}
        )


def test_a_vehicle_is_known_by_its_name_and_by_its_number_in_every_command():
    answers = Answers()
    commands = Commands(answers)
    for verb in ("upload", "start", "pause", "resume", "rtl", "land"):
        for word, name in (("1", "v1"), ("v1", "v1"), ("2", "falcon"), ("falcon", "falcon"), ("9", "v9")):
            assert commands.run([verb, word, *(["plan-1"] if verb == "upload" else [])]) == ["done"]
            assert answers.asked[-1] == f"/api/missions/{name}/{verb}"


def test_all_return_in_turn_and_it_is_said_whose_turn_has_come():
    answers = Answers()
    commands = Commands(answers)
    assert commands.run(["return"]) == ["v1 holds", "done"] and answers.asked == ["/api/missions/all/return"]
    assert "usage" in commands.run(["return", "v1"])[0]
    answers.rows[0]["returns_after"] = ["falcon"]
    assert commands.news() == []
    answers.rows[0]["returns_after"] = None
    [told] = commands.news()
    assert told.startswith("v1 waits no longer: it is told to return")
    assert commands.news() == []


def test_what_goes_wrong_is_said_once():
    answers = Answers()
    commands = Commands(answers)
    assert commands.news() == []
    answers.rows[0]["takeoff"] = {"failed": "refuses to arm"}
    answers.rows[1]["takeoff"] = {"failed": "held on the ground, because v1 did not take off"}
    assert commands.news() == ["v1: refuses to arm", "falcon: held on the ground, because v1 did not take off"]
    near = "v1 and v2 are 6.2 m apart and 0.0 m in height (they should keep 10 m, or 5 m in height): pause v2"
    for row in answers.rows:
        row["alarm"] = near
    assert commands.news() == [near]
    assert commands.news() == []
