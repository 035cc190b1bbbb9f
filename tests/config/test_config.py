"""Settings: what is usual, a file of them, refusals, and whether each stage is handed its own."""

import ast
import dataclasses
import inspect
import json
from pathlib import Path

import pytest

from gcs_plugin.cli.main import main
from orthoswarm.config import DEFAULT, Config, changes, config_of, read_config
from orthoswarm.model.errors import InputError

STAGES = [(stage.name, getattr(DEFAULT, stage.name)) for stage in dataclasses.fields(Config)]


def read(tmp_path, text, encoding="utf-8"):
    file = tmp_path / "config.toml"
    file.write_text(text, encoding=encoding)
    return read_config(file)


def test_every_setting_says_what_it_is():
    """Each field of each stage has a docstring right below it."""
    for _, stage in STAGES:
        body = ast.parse(inspect.getsource(type(stage))).body[0].body
        for node, following in zip(body, [*body[1:], None]):
            if isinstance(node, ast.AnnAssign):
                said = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
                assert said, f"{type(stage).__name__}.{node.target.id} says nothing of its unit, meaning and source"


def test_the_list_of_settings_in_the_documents_is_that_of_the_program():
    """docs/usage.md has a row of each setting with its usual value; of both autopilots, one."""
    text = (Path(__file__).parents[2] / "docs" / "usage.md").read_text(encoding="utf-8")
    cells = [[cell.replace("`", "").strip() for cell in line.strip("|").split("|")] for line in text.splitlines()]
    told = {tuple(row[:3]) for row in cells if row[0].startswith("[") and len(row) == 4}
    known = {(f"[{name}]", f, shown(v)) for name, stage in STAGES for f, v in dataclasses.asdict(stage).items()}
    times = {f: shown(v) for f, v in dataclasses.asdict(DEFAULT.px4).items()}
    known = {row for row in known if row[0] not in ("[ardupilot]", "[px4]")} | {
        ("[ardupilot], [px4]", f, f"{shown(v)}, {times[f]}") for f, v in dataclasses.asdict(DEFAULT.ardupilot).items()
    }
    assert told == known


def shown(value):
    return value if isinstance(value, str) else f"{value:g}"


def test_a_file_stands_in_the_place_of_what_is_usual(tmp_path):
    config = read(tmp_path, "[stereo]\ntallest_m = 120\n[planning]\nlaunch_s = 5\n")
    assert config.stereo.tallest_m == 120.0 and isinstance(config.stereo.tallest_m, float)
    assert changes(config) == {"stereo": {"tallest_m": 120.0}}  # a start each five seconds is usual
    assert config_of(changes(config)) == config and changes(DEFAULT) == {}
    text = "[stereo]\ntallest_m = 120\n"
    assert read(tmp_path, text, "utf-8-sig") == config  # as Windows' Notepad writes it
    assert read(tmp_path, "") == read_config(None) == DEFAULT


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[bundle]\ndrift_mean_share = 1\n", r"no settings \[bundle\], or no longer: they are fixed now; remove them"),
        ("stereo = 3\n", "write it as a table"),
        ("[stereo]\nsmoothness = 1\n", r"no setting stereo.smoothness, or no longer: .*; \[stereo\] has: partners"),
        ("[stereo]\ntallest_m = 'high'\n", "another kind"),
        ("[stereo]\npartners = true\n", "another kind"),
        ("[stereo]\npartners = 2.5\n", "another kind"),
        ("[matchers]\ndevice = 1\n", "another kind"),
        ("[stereo\n", "not a TOML file"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(text, says, tmp_path):
    with pytest.raises(InputError, match=says):
        read(tmp_path, text)


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
    with pytest.raises(InputError, match=f"{stage}.*{line.split()[0]} = .*{allowed}"):
        read(tmp_path, f"[{stage}]\n{line}\n")


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
    assert getattr(getattr(config_of({stage: {name: value}}), stage), name) == value


def test_what_is_usual_is_in_its_own_range():
    assert config_of({name: dataclasses.asdict(stage) for name, stage in STAGES}) == DEFAULT


def test_mosaic_refuses_a_bad_configuration_before_it_begins(tmp_path, capsys):
    file = tmp_path / "config.toml"
    for text, key in (
        ("[stereo]\nnothing = 1\n", "nothing"),
        ("[strategy]\narea_pictures = 0\n", "area_pictures = 0"),
    ):
        file.write_text(text)
        assert main(["mosaic", str(tmp_path), "--config", str(file), "--out", str(tmp_path / "out")]) == 2
        assert key in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_serve_refuses_a_bad_configuration_before_it_begins(tmp_path, capsys):
    file = tmp_path / "config.toml"
    file.write_text("[stereo]\ntallest_m = 'high'\n")
    assert main(["serve", "--workspace", str(tmp_path / "w"), "--config", str(file)]) == 2
    assert "another kind" in capsys.readouterr().err


def made(tmp_path, tmp_path_factory, name, text):
    """The surface of a small map with a configuration, and what the report says was changed."""
    import rasterio

    from tests.kit.scenes import tiny_twin

    folder = tiny_twin(tmp_path_factory, 1, every=2)
    file, out = tmp_path / f"{name}.toml", tmp_path / name
    file.write_text(text)
    flags = ["--config", str(file), "--surface", f"{out}.tif", "--out", str(out), "--workers", "1", "--gsd", "1"]
    assert main(["mosaic", str(folder / "photos"), *flags]) == 0
    with rasterio.open(f"{out}.tif") as raster:
        cell_m = raster.res[0]
    return cell_m, json.loads((out / "report.json").read_text())["config"]


@pytest.mark.slow
def test_a_setting_of_the_surface_reaches_it_and_stands_in_the_report(tmp_path, tmp_path_factory):
    """Cells are as coarse as the pictures that are matched."""
    usual, changed = made(tmp_path, tmp_path_factory, "usual", "")
    assert changed == {}
    coarse, changed = made(tmp_path, tmp_path_factory, "coarse", "[stereo]\nlongest_px = 160\n")
    assert changed == {"stereo": {"longest_px": 160}} and coarse > 1.5 * usual
