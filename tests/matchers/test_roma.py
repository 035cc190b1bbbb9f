"""RoMa's own code with made-up weights, where the extra is installed: weight files to matches within reach."""

import numpy as np
import pytest

from orthoswarm.matchers import roma
from orthoswarm.matchers.network_device import network_device
from orthoswarm.matchers.roma import Roma, load
from orthoswarm.matchers.sparse_learned import read_state

COARSE_PX, UPSAMPLE_PX = 112, 168


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Weight files as published ones are, of a network that has learned nothing."""
    pytest.importorskip("torch")
    try:
        from romatch import roma_outdoor
        from romatch.models.matcher import RegressionMatcher
        from romatch.models.transformer import vit_large
    except (ImportError, RuntimeError) as error:  # a torchvision built for another torch raises RuntimeError
        pytest.skip(f"romatch cannot be imported ({error}); pip install orthoswarm[roma]")
    import torch

    torch.manual_seed(0)
    backbone = vit_large(img_size=518, patch_size=14, init_values=1.0, ffn_layer="mlp", block_chunks=0).state_dict()
    grown = {}
    with monkeypatch.context() as patched:
        patched.setattr(RegressionMatcher, "load_state_dict", lambda self, state: grown.update(self.state_dict()))
        roma_outdoor("cpu", {}, backbone, coarse_res=COARSE_PX, upsample_res=UPSAMPLE_PX, amp_dtype=torch.float32)
    torch.save(grown, tmp_path / "roma_outdoor.pth")
    torch.save(backbone, tmp_path / "dinov2_vitl14_pretrain.pth")
    monkeypatch.setenv("ORTHOSWARM_WEIGHTS", str(tmp_path))


@pytest.mark.slow
def test_roma_is_made_of_its_weight_files_and_matches(files, monkeypatch):
    for name, value in {"_COARSE_PX": COARSE_PX, "_FINE_PX": UPSAMPLE_PX, "_SAMPLES": 500}.items():
        monkeypatch.setattr(roma, name, value)
    network = load(read_state("roma"), read_state("roma-dinov2"), network_device())
    window = np.random.default_rng(0).uniform(0, 255, (200, 240)).astype(np.float32)
    patch = window[20:180, 20:220]
    found = Roma(network).match(patch, np.ones(patch.shape, bool), window, np.ones(window.shape, bool), 20)
    assert found.a.shape == found.b.shape == (len(found), 2)
    if len(found):  # it has learned nothing: where its matches lie is chance, but not how far they may
        assert np.abs(found.b - found.a - 20).max() <= 20 and found.score.min() >= 0.3
        assert found.a.min() >= -0.5 and (found.a <= [199.5, 159.5]).all()
