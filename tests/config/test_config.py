"""The configuration: defaults, overrides from a file, refusals, and workers that follow it."""

import dataclasses
import json

import pytest

from gcs_plugin.cli.main import main
from orthoswarm.compute.workers import Processes
from orthoswarm.config import Config, active, overridden, override, read_overrides
from orthoswarm.model.errors import InputError


@pytest.fixture(autouse=True)
def _defaults():
    yield
    override({})


def tallest(_):
    return active().stereo.tallest_m


def test_every_threshold_says_what_it_is():
    """Each field of each stage has a docstring right below it."""
    import ast
    import inspect

    for stage in dataclasses.fields(Config):
        cls = type(getattr(Config(), stage.name))
        body = ast.parse(inspect.getsource(cls)).body[0].body
        for node, following in zip(body, [*body[1:], None]):
            if isinstance(node, ast.AnnAssign):
                said = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
                assert said, f"{cls.__name__}.{node.target.id} says nothing of its unit, meaning and source"


def test_no_module_reads_the_values_when_it_is_imported():
    """Overrides come later: values are read inside functions, never at module level nor as default arguments."""
    import ast
    from pathlib import Path

    import orthoswarm

    def early(tree):
        inside = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.Lambda):
                body = node.body if isinstance(node.body, list) else [node.body]
                inside |= {id(n) for part in body for n in ast.walk(part)}
        calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]
        return [n.lineno for n in calls if n.func.id == "active" and id(n) not in inside]

    assert early(ast.parse("A = active().x\ndef f(a=active().y): return active().z\n")) == [1, 2]
    files = [f for p in (orthoswarm,) for f in Path(p.__path__[0]).rglob("*.py")]
    found = {f.name: early(ast.parse(f.read_text(encoding="utf-8"))) for f in files}
    assert len(files) > 100 and not {name: lines for name, lines in found.items() if lines}


def test_a_file_overrides_defaults_and_workers_follow(tmp_path):
    file = tmp_path / "config.toml"
    file.write_text("[stereo]\ntallest_m = 55\n")
    override(read_overrides(file))
    assert active().stereo.tallest_m == 55.0 and overridden() == {"stereo": {"tallest_m": 55}}
    with Processes(3) as pool:
        assert set(pool.map(tallest, range(20))) == {55.0}
    file.write_text("[stereo]\ntallest_m = 55\n", encoding="utf-8-sig")  # as Windows' Notepad writes it
    assert read_overrides(file) == {"stereo": {"tallest_m": 55}}
    override({})
    assert active() == Config()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[nothing]\na = 1\n", r"no settings \[nothing\]"),
        ("stereo = 3\n", "write it as a table"),
        ("[stereo]\nnothing = 1\n", "no setting stereo.nothing"),
        ("[stereo]\ntallest_m = 'wide'\n", "another kind"),
        ("[stereo\n", "not a TOML file"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_and_changes_nothing(text, says, tmp_path):
    file = tmp_path / "config.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=says):
        read_overrides(file)
    assert active() == Config()


@pytest.mark.parametrize(
    ("stage", "line", "allowed"),
    [
        ("strategy", "area_pictures = 0", "a number of at least 1"),
        ("stereo", "partners = -3", "a number of at least 1"),
        ("stereo", "partners = 3000000000", "at most 2147483647"),
        ("stereo", "depth_m = 0.0", "a number above 0"),
        ("stereo", "depth_m = nan", "a number above 0"),
        ("stereo", "depth_m = inf", "a number above 0"),
        ("stereo", f"depth_m = 1{'0' * 400}", "a number above 0"),
        ("planning", "in_turn_share = 1.2", "a number of at least 0 and at most 1"),
        ("planning", "launch_s = -1", "a number of at least 0"),
        ("ardupilot", "speed_share = 0", "a number above 0"),
    ],
)
def test_a_number_out_of_range_is_refused_and_the_range_said(stage, line, allowed, tmp_path):
    file = tmp_path / "config.toml"
    file.write_text(f"[{stage}]\n{line}\n")
    with pytest.raises(InputError, match=f"{stage}.*{line.split()[0]} = .*{allowed}"):
        read_overrides(file)
    assert active() == Config()


@pytest.mark.parametrize(
    ("stage", "name", "value"),
    [
        ("planning", "in_turn_share", 0),
        ("planning", "in_turn_share", 1),
        ("planning", "launch_s", 0),  # "none of it", said of the field
        ("ardupilot", "speed_share", 1.001),
    ],
)
def test_a_number_at_the_end_of_its_range_is_taken(stage, name, value):
    override({stage: {name: value}})
    assert getattr(getattr(active(), stage), name) == value


def test_every_default_is_in_its_own_range():
    for stage in dataclasses.fields(Config):
        default = getattr(Config(), stage.name)
        override({stage.name: {f.name: getattr(default, f.name) for f in dataclasses.fields(default)}})
        assert active() == Config()


def test_mosaic_refuses_a_bad_configuration_before_it_begins(tmp_path, capsys):
    file = tmp_path / "config.toml"
    for text, key in (
        ("[stereo]\nnothing = 1\n", "nothing"),
        ("[strategy]\narea_pictures = 0\n", "area_pictures = 0"),
    ):
        file.write_text(text)
        assert main(["mosaic", str(tmp_path), "--config", str(file), "--out", str(tmp_path / "out")]) == 2
        assert key in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_the_report_says_what_was_changed(tmp_path, tmp_path_factory):
    from tests.kit.scenes import tiny_twin

    folder = tiny_twin(tmp_path_factory, 1, every=10)
    file = tmp_path / "config.toml"
    file.write_text("[stereo]\ntallest_m = 80.0\n")
    flags = ["--until", "realtime", "--config", str(file), "--out", str(tmp_path / "out"), "--workers", "1"]
    assert main(["mosaic", str(folder / "photos"), *flags]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["config"] == {"stereo": {"tallest_m": 80.0}}
