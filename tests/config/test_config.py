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


def theta_hat(_):
    return active().records.theta_hat_deg


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
    file.write_text("[records]\ntheta_hat_deg = 55\n")
    override(read_overrides(file))
    assert active().records.theta_hat_deg == 55.0 and overridden() == {"records": {"theta_hat_deg": 55}}
    with Processes(3) as pool:
        assert set(pool.map(theta_hat, range(20))) == {55.0}
    file.write_text("[records]\ntheta_hat_deg = 55\n", encoding="utf-8-sig")  # as Windows' Notepad writes it
    assert read_overrides(file) == {"records": {"theta_hat_deg": 55}}
    override({})
    assert active() == Config()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[nothing]\na = 1\n", r"no settings \[nothing\]"),
        ("records = 3\n", "write it as a table"),
        ("[records]\nnothing = 1\n", "no setting records.nothing"),
        ("[records]\ntheta_hat_deg = 'wide'\n", "another kind"),
        ("[records\n", "not a TOML file"),
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
        ("compute", "pictures_per_task = -3", "a number of at least 1"),
        ("compute", "pictures_per_task = 3000000000", "at most 2147483647"),
        ("coverage", "cell_m = 0.0", "a number above 0"),
        ("coverage", "cell_m = nan", "a number above 0"),
        ("coverage", "cell_m = inf", "a number above 0"),
        ("coverage", f"cell_m = 1{'0' * 400}", "a number above 0"),
        ("coverage", "blurred_share = 1.2", "a number of at least 0 and at most 1"),
        ("coverage", "oblique_deg = 400", "a number above 0 and at most 360"),
        ("records", "usual_overlap = 1", "a number of at least 0 and below 1"),
        ("initial", "default_fov_deg = 180", "a number above 0 and below 180"),
        ("planning", "launch_s = -1", "a number of at least 0"),
        ("ardupilot", "speed_share = 0", "a number above 0"),
        ("mosaic", "most_off_nadir_deg = 120", "below 90"),
        ("records", "usual_heights_m = [50, -1]", "numbers above 0"),
        ("records", "usual_heights_m = [150, 50]", "the smaller number first"),
        ("raster", "stretch_percent = [1, 101]", "numbers of at least 0 and at most 100"),
        ("records", "usual_heights_m = [50, 'far']", "another kind"),
        ("records", "usual_heights_m = [50]", "another kind"),
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
        ("planning", "launch_s", 0),  # "none of it", said of the field
        ("raster", "stretch_percent", (0.0, 100.0)),
        ("ardupilot", "speed_share", 1.001),
        ("coverage", "blurred_share", 0),
        ("coverage", "blurred_share", 1),
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
        ("[records]\nnothing = 1\n", "nothing"),
        ("[strategy]\narea_pictures = 0\n", "area_pictures = 0"),
    ):
        file.write_text(text)
        assert main(["mosaic", str(tmp_path), "--config", str(file), "--out", str(tmp_path / "out")]) == 2
        assert key in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_the_report_says_what_was_changed(tmp_path, tmp_path_factory):
    from tests.kit.scenes import tiny_twin

    folder = tiny_twin(tmp_path_factory, 1, every=10)
    file = tmp_path / "config.toml"
    file.write_text("[records]\ntheta_hat_deg = 80.0\n")
    flags = ["--until", "realtime", "--config", str(file), "--out", str(tmp_path / "out"), "--workers", "1"]
    assert main(["mosaic", str(folder / "photos"), *flags]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["config"] == {"records": {"theta_hat_deg": 80.0}}


def drawn_share(tmp_path, tmp_path_factory, name, text):
    """Share of the real-time map that is drawn, with a configuration, and what the report says was changed."""
    import rasterio

    from tests.kit.scenes import tiny_twin

    folder = tiny_twin(tmp_path_factory, 1, every=10)
    file = tmp_path / f"{name}.toml"
    file.write_text(text)
    out = tmp_path / name
    flags = ["--until", "realtime", "--config", str(file), "--out", str(out), "--workers", "1", "--gsd", "1"]
    assert main(["mosaic", str(folder / "photos"), *flags]) == 0
    with rasterio.open(out / "realtime.tif") as raster:
        area = float((raster.read(4) > 0).sum()) * raster.res[0] ** 2
    return area, json.loads((out / "report.json").read_text())["config"]


def test_an_override_of_the_drawing_draws_otherwise(tmp_path, tmp_path_factory):
    """Ground that is seen farther than 20 degrees from straight down is left out when the file says so."""
    usual, changed = drawn_share(tmp_path, tmp_path_factory, "usual", "")
    assert usual > 0 and changed == {}
    steep, changed = drawn_share(tmp_path, tmp_path_factory, "steep", "[mosaic]\nmost_off_nadir_deg = 20\n")
    assert changed == {"mosaic": {"most_off_nadir_deg": 20}}
    assert 0 < steep < 0.6 * usual


def states_of_legs(tmp_path, tmp_path_factory, name, text):
    """States of the legs after a refinement with a configuration, and what the report says was changed."""
    from tests.kit.scenes import tiny_twin

    folder = tiny_twin(tmp_path_factory, 1)
    file = tmp_path / f"{name}.toml"
    file.write_text(text)
    out = tmp_path / name
    flags = ["--basemap", str(folder / "basemap.tif"), "--config", str(file), "--out", str(out), "--workers", "1"]
    assert main(["mosaic", str(folder / "photos"), *flags, "--gsd", "1"]) == 0
    report = json.loads((out / "report.json").read_text())
    return {leg["state"] for leg in report["legs"]}, report["config"]


@pytest.mark.slow
def test_an_override_of_the_registration_registers_otherwise(tmp_path, tmp_path_factory):
    """With a limit of evidence that nothing can pass the flight is not taken to lie on the map."""
    states, changed = states_of_legs(tmp_path, tmp_path_factory, "usual", "")
    assert "matched" in states and changed == {}
    states, changed = states_of_legs(tmp_path, tmp_path_factory, "strict", "[registration]\nfalse_matches = 1e-300\n")
    assert changed == {"registration": {"false_matches": 1e-300}}
    assert states == {"failed"}
