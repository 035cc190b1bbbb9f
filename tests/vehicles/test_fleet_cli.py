"""`orthoswarm fleet` and `orthoswarm sim` against simulated vehicles on loopback."""

import builtins
import json
import re
import subprocess
import sys
import threading
import time

import pytest

from gcs_plugin.cli.main import main
from gcs_plugin.cli.verbs.fleet import parse_systems
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.mission import mission_files
from gcs_plugin.mission.plan_folder import read_plan_folder
from gcs_plugin.sim.mission_flight import Landed
from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from orthoswarm.model.errors import InputError
from tests.kit.servers.ports import free_port
from tests.vehicles.test_mission_builder import make_plan

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
HOME = (47.3977, 8.5456, 488.0)
pytestmark = pytest.mark.usefixtures("in_vehicle_time")
LONG_S = 240  # real seconds for a flight that takes five


@pytest.fixture
def swarm(request):
    """Three simulated vehicles, at forty times their speed by default; gives the link of a ground station."""
    port, speed = free_port(), getattr(request, "param", 40.0)
    vehicles = make_swarm(3, autopilots=(AP, PX4), home=HOME)
    with SimSwarm(vehicles, f"udpout:127.0.0.1:{port}", speed=speed):
        yield f"udpin:127.0.0.1:{port}"


@pytest.fixture
def folder(tmp_path):
    """A plan for vehicles 1 to 3 as `orthoswarm plan` writes it; they take off a second after each other."""
    plan = make_plan()
    sortie = plan.vehicles[0].sorties[0]
    items = mission_files.sortie_items(plan, sortie, "ardupilot")
    vehicles = []
    for number in (1, 2, 3):
        text = mission_files.plan_text(items, HOME, "ardupilot", 8.0)
        (tmp_path / f"v{number}.plan").write_text(text)
        (tmp_path / f"v{number}.waypoints").write_text(mission_files.waypoints_text(items, HOME))
        files = [f"v{number}.plan", f"v{number}.waypoints"]
        vehicles.append({"id": f"v{number}", "flights": [{"files": files, "start_s": 5.0 + 0.5 * number}]})
    (tmp_path / "plan.json").write_text(json.dumps({"vehicles": vehicles}))
    return tmp_path


def fleet(capsys, *words):
    code = main(["fleet", *map(str, words)])
    out = capsys.readouterr().out
    return code, json.loads(out) if "--json" in words and out else out


def test_a_plan_is_uploaded_flown_and_watched_to_its_completion(swarm, folder, capsys):
    code, listed = fleet(capsys, "list", "--link", swarm, "--json")
    assert code == 0
    assert [(v["id"], v["autopilot"]) for v in listed["vehicles"]] == [
        ("v1", "ardupilot"),
        ("v2", "px4"),
        ("v3", "ardupilot"),
    ]
    code, uploaded = fleet(capsys, "upload", folder, "--link", swarm, "--json")
    assert code == 0 and all(v["ok"] for v in uploaded["vehicles"])
    assert [v["items"] for v in uploaded["vehicles"]] == [13, 12, 13]
    words = ["--override", "separation", "--plan", folder, "--watch", "--seconds", LONG_S, "--link", swarm, "--json"]
    code = main(["fleet", "start", *map(str, words)])
    out, said = capsys.readouterr()
    flown = json.loads(out)
    assert code == 0 and flown["ended"]
    for vehicle in ("v1", "v2", "v3"):
        kinds = [e["kind"] for e in flown["events"] if e["vehicle"] == vehicle]
        assert kinds.count("complete") == 1 and kinds.count("started") == 1
    assert re.findall(r"vehicle (\d) flies its mission", said) == ["1", "2", "3"]  # at the plan's times
    assert all(v["photos"] > 10 for v in flown["vehicles"])


def test_events_are_told_while_others_wait_and_a_return_from_elsewhere_is_heard(folder, capsys):
    """Two terminals: one starts a plan, the other sends all home while the second vehicle waits for its takeoff."""
    document = json.loads((folder / "plan.json").read_text())
    for number, vehicle in enumerate(document["vehicles"]):
        vehicle["flights"][0]["start_s"] = 3.0 * number
    (folder / "plan.json").write_text(json.dumps({"vehicles": document["vehicles"][:2]}))
    port = free_port()
    vehicles = make_swarm(2, home=HOME)
    with SimSwarm(vehicles, f"udpout:127.0.0.1:{port}", speed=8.0):
        link = f"udpin:127.0.0.1:{port}"
        assert fleet(capsys, "upload", folder, "--vehicle", "1,2", "--link", link)[0] == 0

        def elsewhere():
            while vehicles[0].flight.motion.up < 3.0:
                time.sleep(0.02)
            for vehicle in vehicles:
                vehicle.flight.set_mode(vehicle.flight.modes.rtl)

        other = threading.Thread(target=elsewhere, daemon=True)
        other.start()
        words = ["--plan", folder, "--override", "separation", "--watch", "--seconds", LONG_S, "--link", link]
        code, said = fleet(capsys, "start", *words)
        other.join(60.0)
    lines = said.splitlines()
    stays = next(k for k, line in enumerate(lines) if "vehicle 2 was put into RTL since its start was given" in line)
    assert code == 1 and not vehicles[1].flight.armed
    assert any("vehicle 1 has started its mission" in line for line in lines[:stays]), lines
    assert any("vehicle 1 has left its mission and is in RTL" in line for line in lines[:stays]), lines


def test_a_px4_is_watched_until_it_has_come_home(folder, capsys):
    """Its mission is complete when the way home begins, tens of metres up."""
    port = free_port()
    link = f"udpin:127.0.0.1:{port}"
    with SimSwarm(make_swarm(1, autopilots=(PX4,), home=HOME), f"udpout:127.0.0.1:{port}", speed=40.0):
        assert fleet(capsys, "upload", folder / "v1.plan", "--link", link)[0] == 0
        code, flown = fleet(capsys, "start", "--watch", "--seconds", LONG_S, "--link", link, "--json")
    assert code == 0 and flown["ended"]
    (vehicle,) = flown["vehicles"]  # "on ground" until it says that its motors are off
    assert vehicle["flight"]["state"] in ("complete", "on ground")


def test_nobody_is_started_while_one_vehicle_holds_another_mission_than_the_plans(swarm, folder, capsys):
    assert fleet(capsys, "upload", folder, "--link", swarm)[0] == 0
    other = folder / "other.waypoints"
    lines = (folder / "v2.waypoints").read_text().splitlines()
    other.write_text("\n".join(line.replace("\t60.000\t", "\t61.000\t") for line in lines))
    assert fleet(capsys, "upload", other, "--vehicle", "2", "--link", swarm)[0] == 0
    code, said = fleet(capsys, "start", "--override", "separation", "--plan", folder, "--link", swarm, "--json")
    assert code == 1 and not any(v["ok"] for v in said["vehicles"])
    assert (
        "does not hold this plan's mission" in said["vehicles"][1]["text"]
        and "its height is 61" in said["vehicles"][1]["text"]
    )
    code, listed = fleet(capsys, "list", "--link", swarm, "--json")
    assert not any(v["armed"] for v in listed["vehicles"])


@pytest.mark.parametrize("swarm", [4.0], indirect=True)  # its mission takes 40 s, so that it flies when it is paused
def test_one_vehicle_is_started_paused_resumed_and_brought_home(swarm, folder, capsys):
    assert fleet(capsys, "upload", folder / "v1.plan", "--vehicle", "v3", "--link", swarm)[0] == 0
    code, text = fleet(capsys, "start", "--vehicle", "3", "--link", swarm)
    assert code == 0 and "vehicle 3 flies its mission" in text
    for action in ("pause", "resume", "rtl"):
        code, said = fleet(capsys, action, "--vehicle", "3", "--link", swarm, "--json")
        assert code == 0 and said["vehicles"][0]["ok"], str(said)
    code, said = fleet(capsys, "start", "--vehicle", "2", "--link", swarm, "--json")
    assert code == 1 and "no mission" in said["vehicles"][0]["text"]


@pytest.fixture
def flying(request):
    """Three simulated vehicles of one start that hold over one place; gives the link of a ground station."""
    port, speed = free_port(), request.param
    vehicles = make_swarm(3, home=HOME, spacing_m=4.0, ready_s=0.0)
    for k, vehicle in enumerate(vehicles):
        flight = vehicle.flight
        flight.motion.north, flight.motion.east, flight.motion.up = 60.0, 20.0 * k, 25.0
        flight.armed, flight.landed = True, Landed.IN_AIR
        flight.set_mode(flight.modes.hold)
    with SimSwarm(vehicles, f"udpout:127.0.0.1:{port}", speed=speed) as swarm:
        yield swarm, f"udpin:127.0.0.1:{port}"


@pytest.mark.parametrize("flying", [40.0], indirect=True)
def test_vehicles_of_one_start_return_in_turn(flying, capsys):
    swarm, link = flying
    assert main(["fleet", "rtl", "--in-turn", "--link", link, "--json"]) == 0
    captured = capsys.readouterr()
    rows = json.loads(captured.out)["vehicles"]
    assert [(row["id"], row["command"], row["outcome"]) for row in rows] == [
        (f"v{n}", "rtl", "done") for n in (1, 2, 3)
    ]
    said = captured.err.splitlines()
    assert sum("holds, and returns after vehicle" in line for line in said) == 2
    modes = [vehicle.flight.modes.name(vehicle.flight.mode) for vehicle in swarm.vehicles.values()]
    assert modes == ["RTL"] * 3


@pytest.mark.parametrize("flying", [1.0], indirect=True)
def test_whoever_waits_is_left_holding_by_ctrl_c_and_that_is_said(flying, capsys, monkeypatch):
    swarm, link = flying
    written = builtins.print

    def interrupted(text="", **options):
        written(text, **options)
        if "returns after" in str(text):
            raise KeyboardInterrupt

    monkeypatch.setattr(builtins, "print", interrupted)
    assert main(["fleet", "rtl", "--in-turn", "--link", link]) == 130
    captured = capsys.readouterr()
    assert captured.out.count("holds where it is and was not sent home") == 2
    assert "run the same command again to go on" in captured.err
    assert sorted(v.flight.modes.name(v.flight.mode) for v in swarm.vehicles.values()) == ["BRAKE", "BRAKE", "RTL"]


@pytest.mark.parametrize("flying", [1.0], indirect=True)
def test_turns_that_take_too_long_end_with_exit_code_one(flying, capsys):
    _, link = flying
    words = ("rtl", "--in-turn", "--seconds", 0.2, "--vehicle", "1,3,9", "--wait", 1, "--link", link)
    code, said = fleet(capsys, *words, "--json")
    assert code == 1
    assert sorted(row["outcome"] for row in said["vehicles"]) == ["done", "not_sent", "not_sent"]  # 2 is told nothing
    assert {row["text"] for row in said["vehicles"] if row["id"] == "v9"} == {
        "vehicle 9 was not heard; check its link and system id"
    }


def test_a_refused_mission_is_explained_in_words_and_in_json(swarm, folder, capsys):
    path = folder / "v1.waypoints"
    lines = path.read_text().splitlines()
    lines[4] = lines[4].replace("\t16\t", "\t214\t")
    path.write_text("\n".join(lines))
    code, said = fleet(capsys, "upload", path, "--vehicle", "1", "--link", swarm, "--json")
    row = said["vehicles"][0]
    assert code == 1 and not row["ok"]
    assert row["refusal"] == {"code": 3, "item": 3, "field": "command"}
    assert "item 3 (DO_SET_CAM_TRIGG_INTERVAL) is a command that it does not know" in row["text"]


def test_mavsdk_flies_them_too(swarm, folder, capsys):
    pytest.importorskip("mavsdk")
    both = ("--vehicle", "1,2", "--link", swarm, "--backend", "mavsdk", "--wait", "60", "--json")
    code, uploaded = fleet(capsys, "upload", folder, *both)
    assert code == 0 and all(v["ok"] for v in uploaded["vehicles"]), uploaded
    code, refused = fleet(capsys, "start", *both)
    assert code == 1 and "separation: comes within" in refused["vehicles"][0]["text"]  # one path, at one time
    code, flown = fleet(capsys, "start", "--watch", "--seconds", LONG_S, "--override", "separation", *both)
    assert code == 0, flown
    assert sorted(e["vehicle"] for e in flown["events"] if e["kind"] == "complete") == ["v1", "v2"]


@pytest.mark.parametrize("swarm", [5.0], indirect=True)
def test_mavsdk_pauses_what_flies_as_soon_as_it_is_seen(swarm, folder, capsys):
    """MAVSDK knows of it before its state has come: not seen armed is not disarmed."""
    pytest.importorskip("mavsdk")
    one = ("--vehicle", "1", "--link", swarm, "--backend", "mavsdk", "--wait", "60", "--json")
    assert fleet(capsys, "upload", folder, *one)[0] == 0
    code, said = fleet(capsys, "start", *one)
    assert code == 0, said["vehicles"][0]["text"]
    code, said = fleet(capsys, "pause", *one)
    assert code == 0 and said["vehicles"][0]["outcome"] == "done", said


def test_nobody_on_the_link_is_said_with_exit_code_one(capsys):
    code = main(["fleet", "list", "--link", f"udpin:127.0.0.1:{free_port()}", "--wait", "0.3", "--json"])
    captured = capsys.readouterr()
    assert code == 1
    assert json.loads(captured.out)["vehicles"] == []
    assert "no vehicle heard" in captured.err and "check links" in captured.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["list", "--link", "nonsense"], "is not a link"),
        (["list", "--vehicle", "x"], "is not a vehicle"),
        (["list", "--gcs-system", "300"], "1 to 255"),
        (["list", "--wait", "-1"], "is not a time"),
        (["watch", "--seconds", "nan"], "is not a time"),
        (["upload", "absent.plan"], "does not exist"),
        (["start", "--plan", "absent"], "holds no missions"),
        (["list", "--signing-key", "absent"], "cannot be read"),
        (["list", "--backend", "mavsdk", "--tlog", "x.tlog"], "use --backend pymavlink"),
    ],
)
def test_wrong_arguments_get_one_sentence_and_exit_code_two(words, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["fleet", *words]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_whose_mission_a_file_is_must_be_clear(folder, capsys):
    one = folder / "survey.plan"
    (folder / "v1.plan").rename(one)
    assert main(["fleet", "upload", str(one), str(folder / "v2.plan")]) == 2
    assert "whose mission is survey.plan" in capsys.readouterr().err
    assert main(["fleet", "upload", str(folder), "--vehicle", "9"]) == 2
    assert "no mission for vehicle 9" in capsys.readouterr().err


def test_a_plans_folder_tells_files_and_times(folder):
    flights = read_plan_folder(folder, 1)
    assert {s: (path.name, start) for s, (path, start) in flights.items()} == {
        1: ("v1.plan", 5.5), 2: ("v2.plan", 6.0), 3: ("v3.plan", 6.5),
    }  # fmt: skip
    with pytest.raises(InputError, match="no sortie 2"):
        read_plan_folder(folder, 2)
    (folder / "plan.json").unlink()
    assert sorted(read_plan_folder(folder, 1)) == [1, 2, 3]


def test_vehicles_are_named_in_any_usual_way():
    assert parse_systems(["3", "v7,1", "3"]) == [1, 3, 7]
    with pytest.raises(InputError):
        parse_systems(["0"])


def test_simulated_vehicles_run_from_the_command_line():
    port = free_port()
    command = [
        sys.executable,
        "-m",
        "gcs_plugin.cli",
        "sim",
        "--vehicles",
        "2",
        "--autopilot",
        "mixed",
        "--speed",
        "10",
    ]
    with subprocess.Popen([*command, "--link", f"udpout:127.0.0.1:{port}"], stderr=subprocess.PIPE) as process:
        try:
            from gcs_plugin.fleet.fleet import Fleet

            with Fleet([f"udpin:127.0.0.1:{port}"]) as heard:
                assert heard.run_until(lambda: len(heard.vehicles) == 2, 200.0)
        finally:
            process.terminate()


def test_simulated_vehicles_end_by_themselves(capsys):
    words = ["--vehicles", "1", "--link", f"udpout:127.0.0.1:{free_port()}", "--speed", "50", "--seconds", "20"]
    assert main(["sim", *words, "--reboot", "1@5", "--silence", "1@10+2"]) == 0
    said = capsys.readouterr().err
    assert "vehicle 1: reboot" in said and "vehicle 1: silence" in said


def test_what_is_due_before_the_end_happens_though_the_machine_was_busy(capsys, monkeypatch):
    """The first look comes after the end."""
    monkeypatch.setattr(SimSwarm, "now", property(lambda swarm: 100.0))
    words = ["--vehicles", "1", "--link", f"udpout:127.0.0.1:{free_port()}", "--seconds", "20"]
    assert main(["sim", *words, "--reboot", "1@5", "--silence", "1@30+2"]) == 0
    said = capsys.readouterr().err
    assert "vehicle 1: reboot" in said and "silence" not in said


@pytest.mark.parametrize(
    "words",
    [["--vehicles", "0"], ["--home", "x"], ["--reboot", "1"], ["--reboot", "9@1"], ["--loss", "2"], ["--speed", "0"]],
)
def test_impossible_simulations_are_refused(words, capsys):
    assert main(["sim", *words]) == 2
    assert capsys.readouterr().err.count("\n") == 1
