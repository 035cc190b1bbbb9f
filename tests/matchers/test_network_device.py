"""Networks run on the device that is asked for, and one that is not there is refused before the run."""

import numpy as np
import pytest

from gcs_plugin.cli.main import main
from orthoswarm.matchers.matcher import UnavailableError
from orthoswarm.matchers.network_device import network_device, require_device
from orthoswarm.model.errors import InputError


@pytest.fixture(scope="module")
def torch():
    return pytest.importorskip("torch")


@pytest.mark.parametrize(("card", "name", "kind"), [
    (False, "auto", "cpu"), (False, "cpu", "cpu"), (True, "auto", "cuda"), (True, "cpu", "cpu"), (True, "cuda", "cuda"),
])  # fmt: skip
def test_the_device_asked_for_is_used(torch, monkeypatch, card, name, kind):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: card)
    require_device(name)
    assert network_device(name).type == kind


@pytest.mark.parametrize(("name", "words"), [("cuda", "sees no CUDA card"), ("gpu0", "no device 'gpu0'")])
def test_a_device_that_is_not_there_is_refused(torch, monkeypatch, name, words):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UnavailableError, match=words):
        network_device(name)
    with pytest.raises(InputError, match=words):
        require_device(name)


def test_mosaic_refuses_it_before_it_writes(torch, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    (tmp_path / "photos").mkdir()
    assert main(["mosaic", str(tmp_path / "photos"), "--out", str(tmp_path / "map"), "--device", "cuda"]) == 2
    assert "sees no CUDA card" in capsys.readouterr().err
    assert not (tmp_path / "map").exists()


def test_a_card_finds_what_the_cpu_finds(torch):
    if not torch.cuda.is_available():
        pytest.skip("no CUDA card")
    from orthoswarm.matchers import picture_matcher

    rng = np.random.default_rng(1)
    scene = (rng.random((40, 52)) * 255).astype(np.uint8).repeat(8, 0).repeat(8, 1)
    found = {}
    for name in ("cpu", "cuda"):
        found[name] = picture_matcher("xfeat", name).match(scene[:256, :320], scene[20:276, 30:350])
    shifts = {name: np.median(each.b - each.a, axis=0) for name, each in found.items()}
    assert len(found["cuda"]) > 50
    assert np.abs(shifts["cuda"] - shifts["cpu"]).max() < 0.02
