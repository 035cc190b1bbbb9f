"""docs/sitl.md, as a reader copies it: its commands are ones that there are, and with `-m sitl` they fly as they stand.

The autopilots are those of ORTHOSWARM_ARDUCOPTER (the program) with ORTHOSWARM_ARDUPILOT (its source folder), and of
ORTHOSWARM_PX4 (its build folder). The ports are the page's own: they must be free.
"""

import argparse
import contextlib
import importlib
import os
import re
import shlex
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from gcs_plugin.cli.main import main
from tests.vehicles.autopilots.test_twin_camera import Followed

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs" / "sitl.md").read_text(encoding="utf-8")
LIMIT_S = 900.0  # of one command: a flight takes five minutes


@dataclass(frozen=True)
class Command:
    """A command of the page: its words, without the variables before them."""

    words: tuple[str, ...]
    variables: tuple[str, ...]

    @property
    def kind(self):
        """What it is for: `serve`, `twin camera`, `fleet start`, and so on, or `autopilot`."""
        if self.words[0] != "orthoswarm":
            return "autopilot"
        return " ".join(self.words[1 : 3 if self.words[1] in ("twin", "fleet") else 2])


def commands(text):
    """The commands of indented blocks, a line each; a backslash joins lines."""
    lines = re.findall(r"^ {4}(.*)", re.sub(r"\\\n\s*", "", text), re.MULTILINE)
    split = [shlex.split(line, comments=True) for line in lines]
    begins = [next(k for k, word in enumerate(words) if not re.match(r"[A-Z0-9_]+=", word)) for words in split]
    return [Command(tuple(words[k:]), tuple(words[:k])) for words, k in zip(split, begins)]


def section(title):
    return re.search(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL)[1]


OURS = [command for command in commands(PAGE) if command.words[0] == "orthoswarm"]


def parsed(words, monkeypatch):
    """What the command line makes of a command, which is not run."""
    found = []
    module = importlib.import_module(f"gcs_plugin.cli.verbs.{words[1]}")
    monkeypatch.setattr(module, "run", lambda args: found.append(args) or 0)
    assert main(list(words[1:])) == 0
    return found[0]


@pytest.mark.parametrize("command", OURS, ids=lambda command: command.kind)
def test_each_command_of_the_page_is_one_that_there_is(command, monkeypatch):
    args = parsed(command.words, monkeypatch)
    assert isinstance(args, argparse.Namespace)
    if command.kind == "plan":  # else the takeoff lies at the first line, and the vehicle stands elsewhere
        assert len(args.start) == args.vehicles


def test_commands_within_sentences_have_verbs_and_options_that_there_are(monkeypatch):
    quoted = [shlex.split(text) for text in re.findall(r"`(orthoswarm [^`]+)`", PAGE)]
    assert quoted
    for words in quoted:
        if words[1:] != ["twin", "camera"]:  # named, not to be typed
            parsed(words, monkeypatch)


def test_a_flight_has_all_its_commands_on_the_page():
    wanted = ["autopilot", "twin camera", "serve", "plan", "fleet upload", "fleet start", "evaluate"]
    for title in ("One ArduCopter", "PX4"):
        assert [command.kind for command in flight(title)] == wanted


def flight(title):
    """The commands of a flight in their order: those of one ArduCopter, unless the section has its own."""
    first = {command.kind: command for command in commands(section("One ArduCopter"))}
    return list((first | {command.kind: command for command in commands(section(title))}).values())


def place(name):
    """A path of the environment."""
    if not os.environ.get(name):
        pytest.skip(f"{name} names no autopilot")
    return str(Path(os.environ[name]).resolve())


def on_this_machine(command, places):
    """The words and the environment with which a command is run here."""
    ours = [sys.executable, "-m", "gcs_plugin.cli"] if command.words[0] == "orthoswarm" else None
    words = [re.sub(r"^(arducopter$|ARDUPILOT|BUILD)", lambda m: places[m[0]], word) for word in command.words]
    variables = dict(text.split("=", 1) for text in command.variables)
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    return (ours + words[1:] if ours else words), os.environ | variables | {"PYTHONPATH": path}


def end(followed):
    """As with Ctrl-C."""
    followed.process.send_signal(signal.SIGINT)
    with contextlib.suppress(subprocess.TimeoutExpired):
        followed.process.wait(30)
    followed.close()


@pytest.mark.sitl
@pytest.mark.timeout(3000)
@pytest.mark.parametrize(
    ("title", "names"),
    [
        ("One ArduCopter", {"arducopter": "ORTHOSWARM_ARDUCOPTER", "ARDUPILOT": "ORTHOSWARM_ARDUPILOT"}),
        ("PX4", {"BUILD": "ORTHOSWARM_PX4"}),
    ],
)
def test_the_page_flies_as_it_stands(title, names, tmp_path):
    places = {word: place(name) for word, name in names.items()}
    says = {"autopilot": "", "twin camera": "map: ", "serve": r"map: http"}  # those that run until they are ended
    with contextlib.ExitStack() as running:
        for command in flight(title):
            words, environment = on_this_machine(command, places)
            if command.kind in says:
                process = Followed(words, cwd=tmp_path, env=environment, stdin=subprocess.DEVNULL)
                running.callback(end, process)
                assert not says[command.kind] or process.wait_for(says[command.kind], LIMIT_S)
                continue
            done = subprocess.run(
                words, cwd=tmp_path, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT, text=True, timeout=LIMIT_S,
            )  # fmt: skip
            print(f"$ {shlex.join(command.words)}\n{done.stdout}")
            assert done.returncode == 0, done.stdout
        median = re.search(r"^median_m\s+([\d.]+)", done.stdout, re.MULTILINE)
        assert float(median[1]) < 0.5
