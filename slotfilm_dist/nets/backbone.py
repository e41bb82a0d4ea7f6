"""ResNet-18 up to its third stage, the image encoder of Section 4.1, and where its weights come from."""

import hashlib
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from jaxtyping import Float, UInt8
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from slotfilm_dist.config import EncoderConfig
from slotfilm_dist.weights_file import weights_file_sha256

FEATURE_CHANNELS = 256
"""Channels of the feature map."""

STRIDE = 16
"""Pixels of the picture per cell of the feature map, along each side."""

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
_UNUSED_PREFIXES = ("layer4.", "fc.")
_COUNTER = "num_batches_tracked"


class Backbone(nn.Module):
    """ResNet-18 truncated after its third stage: 2,782,784 parameters, stride 16, 256 channels.

    Parameters carry torchvision's names below `trunk.`. It is built here, because to import torchvision takes a process
    as long as to import torch, and every worker that is replaced would wait for that. Everything is kept in the
    channels-last layout, in which a picture already is when its colour axis comes last, so that no copy is made on the
    way in or out.
    """

    scale: Tensor
    shift: Tensor

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__()
        with torch.device("meta"):
            self.trunk = _trunk()
        self.trunk.to_empty(device="cpu")
        for module in self.trunk.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu", generator=generator)
            elif isinstance(module, nn.BatchNorm2d):
                module.reset_parameters()
        self.trunk.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's stubs
        std = torch.tensor(IMAGENET_STD).view(1, 3, 1, 1)
        self.register_buffer("scale", 1.0 / (255.0 * std), persistent=False)
        self.register_buffer("shift", -torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1) / std, persistent=False)

    def forward(self, rgb: UInt8[Tensor, "batch height width 3"]) -> Float[Tensor, "batch tokens channels"]:
        """The feature map, cell by cell, row by row; the picture is normalised here and nowhere else."""
        picture = rgb.permute(0, 3, 1, 2).to(self.scale.dtype).mul_(self.scale).add_(self.shift)
        return self.trunk(picture).permute(0, 2, 3, 1).flatten(1, 2)


class _Block(nn.Module):
    """Two convolutions around which the input is added (He et al. 2016), with torchvision's names and order."""

    def __init__(self, channels_in: int, channels: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.relu = nn.ReLU(inplace=True)
        self.conv2 = nn.Conv2d(channels, channels, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)
        self.downsample: nn.Module | None = None
        if stride > 1:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels_in, channels, 1, stride, bias=False), nn.BatchNorm2d(channels)
            )

    def forward(self, x: Float[Tensor, "batch channels height width"]) -> Float[Tensor, "batch out height2 width2"]:
        """The block's output."""
        out = self.relu(self.bn1(self.conv1(x)))
        out = self.bn2(self.conv2(out))
        out += x if self.downsample is None else self.downsample(x)
        return self.relu(out)


def _trunk() -> nn.Sequential:
    """ResNet-18 as torchvision builds it, up to its third stage."""
    stages: list[tuple[str, nn.Module]] = [
        ("conv1", nn.Conv2d(3, 64, 7, 2, 3, bias=False)),
        ("bn1", nn.BatchNorm2d(64)),
        ("relu", nn.ReLU(inplace=True)),
        ("maxpool", nn.MaxPool2d(3, 2, 1)),
    ]
    for number, (before, channels) in enumerate(((64, 64), (64, 128), (128, FEATURE_CHANNELS)), start=1):
        first = _Block(before, channels, stride=1 if before == channels else 2)
        stages.append((f"layer{number}", nn.Sequential(first, _Block(channels, channels, stride=1))))
    return nn.Sequential(OrderedDict(stages))


def load_initial_weights(backbone: Backbone, config: EncoderConfig) -> None:
    """Fill the backbone as `encoder.backbone` asks; with `random` it stays as it was drawn.

    Raises:
        ValueError: the download or the file cannot be had, or the file does not fit a ResNet-18.
    """
    if config.backbone == "imagenet":
        _load(backbone, _download_imagenet(), "torchvision's ImageNet weights")
    elif config.backbone == "path":
        weights_file_sha256(config)  # refuses another file than the run began with
        _load(backbone, _read(Path(config.backbone_path)), f"encoder.backbone_path = {config.backbone_path!r}")


def weights_hash(named: Iterable[tuple[str, Tensor]]) -> str:
    """First 16 hex digits of SHA-256 over names, shapes and bytes, in the order of the names.

    BatchNorm's counters of training batches are left out: they change no output.
    """
    digest = hashlib.sha256()
    for name, value in sorted(named, key=lambda item: item[0]):
        if name.endswith(_COUNTER):
            continue
        array = value.detach().cpu().contiguous().numpy()
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()[:16]


def _download_imagenet() -> Mapping[str, Any]:
    from torchvision.models import ResNet18_Weights

    try:
        return ResNet18_Weights.IMAGENET1K_V1.get_state_dict(progress=False, check_hash=True)
    except (OSError, RuntimeError) as error:
        raise ValueError(
            f"encoder.backbone = 'imagenet': torchvision could not fetch its ResNet-18 weights ({error}); pass a file "
            "with --encoder.backbone path --encoder.backbone-path FILE, or start from --encoder.backbone random"
        ) from None


def _read(path: Path) -> Mapping[str, Any]:
    """The tensors of a .safetensors or torch file; never runs code that the file brings."""
    where = f"encoder.backbone_path = {str(path)!r}"
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (SafetensorError, UnpicklingError, RuntimeError, EOFError, OSError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ValueError(f"{where} is neither a .safetensors file nor a plain torch state dict: {reason}") from None
    if not isinstance(state, Mapping):
        raise ValueError(f"{where} holds a {type(state).__name__}; save the state dict of a torchvision resnet18")
    return state


def _load(backbone: Backbone, state: Mapping[str, Any], where: str) -> None:
    """Copy the weights after checking their names, shapes and values; later stages are ignored."""
    wanted = backbone.trunk.state_dict()
    given = {name: value for name, value in state.items() if not name.startswith(_UNUSED_PREFIXES)}
    missing = [name for name in wanted if name not in given and not name.endswith(_COUNTER)]
    unknown = [name for name in given if name not in wanted]
    if missing or unknown:
        lacks = [f"lacks {_some(missing)}"] * bool(missing) + [f"has unknown {_some(unknown)}"] * bool(unknown)
        raise ValueError(f"{where} {' and '.join(lacks)}; save the state dict of a torchvision resnet18")
    for name, value in given.items():
        if not isinstance(value, Tensor) or value.shape != wanted[name].shape:
            shape = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
            raise ValueError(f"{where}: {name} is {shape}, a resnet18 has {tuple(wanted[name].shape)}")
        if not bool(torch.isfinite(value).all()):
            raise ValueError(f"{where}: {name} holds numbers that are not finite; the file is damaged")
    backbone.trunk.load_state_dict(wanted | given)


def _some(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
