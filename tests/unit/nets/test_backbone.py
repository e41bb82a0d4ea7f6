"""The truncated ResNet-18 and the sources of its weights."""

import dataclasses
import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor
from torchvision.models import ResNet18_Weights, resnet18

from slotfilm_dist.config import EncoderConfig
from slotfilm_dist.nets.backbone import Backbone, load_initial_weights, weights_hash
from slotfilm_dist.weights_file import weights_file_sha256


def drawn(seed: int) -> Backbone:
    return Backbone(torch.Generator().manual_seed(seed)).eval()


def from_file(path: Path) -> Backbone:
    backbone = drawn(7)
    load_initial_weights(backbone, EncoderConfig(backbone="path", backbone_path=str(path)))
    return backbone


def whole_resnet() -> dict[str, Tensor]:
    """A torchvision state dict with statistics that are not the initial ones."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        net = resnet18(weights=None)
    generator = torch.Generator().manual_seed(5)
    for name, buffer in net.named_buffers():
        if name.endswith("running_var"):
            buffer.copy_(0.5 + torch.rand(buffer.shape, generator=generator))
    return net.state_dict()


def pictures(seed: int = 0) -> Tensor:
    return torch.randint(0, 256, (2, 64, 64, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(seed))


def test_backbone_has_the_parameters_of_a_resnet18_up_to_its_third_stage() -> None:
    assert sum(p.numel() for p in drawn(0).parameters()) == 2_782_784


def test_features_are_those_of_torchvision_on_normalised_pictures(tmp_path: Path) -> None:
    state = whole_resnet()
    save_file(state, tmp_path / "resnet.safetensors")
    net = resnet18(weights=None).eval()
    net.load_state_dict(state)
    transform = ResNet18_Weights.IMAGENET1K_V1.transforms()
    picture = (pictures().permute(0, 3, 1, 2) / 255 - torch.tensor(transform.mean).view(3, 1, 1)) / torch.tensor(
        transform.std
    ).view(3, 1, 1)
    for stage in (net.conv1, net.bn1, net.relu, net.maxpool, net.layer1, net.layer2, net.layer3):
        picture = stage(picture)
    features = from_file(tmp_path / "resnet.safetensors")(pictures())
    assert features.shape == (2, 16, 256)
    for row, col in ((0, 0), (1, 2), (3, 3)):
        torch.testing.assert_close(features[:, 4 * row + col], picture[:, :, row, col], atol=2e-4, rtol=1e-4)


def test_torch_file_and_safetensors_file_give_the_same_weights(tmp_path: Path) -> None:
    state = whole_resnet()
    save_file(state, tmp_path / "resnet.safetensors")
    torch.save(state, tmp_path / "resnet.pt")
    hashes = [
        weights_hash(from_file(tmp_path / name).state_dict().items()) for name in ("resnet.safetensors", "resnet.pt")
    ]
    assert hashes[0] == hashes[1]


def test_random_weights_follow_their_seed_and_leave_the_global_generator_alone() -> None:
    before = torch.get_rng_state()
    first, again, other = drawn(0), drawn(0), drawn(1)
    assert torch.equal(torch.get_rng_state(), before)
    assert weights_hash(first.state_dict().items()) == weights_hash(again.state_dict().items())
    assert weights_hash(first.state_dict().items()) != weights_hash(other.state_dict().items())


def test_hash_sees_one_changed_statistic_but_not_the_batch_counter() -> None:
    backbone = drawn(0)
    before = weights_hash(backbone.state_dict().items())
    backbone.state_dict()["trunk.bn1.num_batches_tracked"].add_(1)
    assert weights_hash(backbone.state_dict().items()) == before
    backbone.state_dict()["trunk.layer3.1.bn2.running_mean"][17] += 1e-6
    assert weights_hash(backbone.state_dict().items()) != before
    assert len(before) == 16


@pytest.mark.parametrize("damage", ["missing", "shape", "not finite", "unknown"])
def test_file_that_does_not_fit_is_refused_by_name(tmp_path: Path, damage: str) -> None:
    state = whole_resnet()
    name = "layer2.0.conv1.weight"
    if damage == "missing":
        del state[name]
    elif damage == "shape":
        state[name] = state[name][:1].clone()
    elif damage == "not finite":
        state[name][0, 0, 0, 0] = torch.nan
    else:
        name = "layer2.9.conv1.weight"
        state[name] = torch.zeros(1)
    torch.save(state, tmp_path / "resnet.pt")
    with pytest.raises(ValueError, match=name):
        from_file(tmp_path / "resnet.pt")


class Bomb:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return (Path.touch, (self.path,))


def test_other_weights_of_the_same_name_are_told_apart_and_refused(tmp_path: Path) -> None:
    path = tmp_path / "resnet.safetensors"
    save_file(whole_resnet(), path)
    config = EncoderConfig(backbone="path", backbone_path=str(path))
    config = dataclasses.replace(config, backbone_sha256=weights_file_sha256(config))
    load_initial_weights(drawn(7), config)
    save_file({name: value * 2 for name, value in whole_resnet().items()}, path)
    with pytest.raises(ValueError, match=r"is not the file that encoder\.backbone_sha256 names"):
        load_initial_weights(drawn(7), config)


def test_file_that_brings_code_is_refused_without_running_it(tmp_path: Path) -> None:
    trace = tmp_path / "ran"
    torch.save({"conv1.weight": Bomb(trace)}, tmp_path / "resnet.pt")
    (tmp_path / "plain.pt").write_bytes(pickle.dumps(Bomb(trace), protocol=2))
    for name in ("resnet.pt", "plain.pt"):
        with pytest.raises(ValueError, match=r"encoder\.backbone_path"):
            from_file(tmp_path / name)
    assert not trace.exists()


@pytest.mark.parametrize("name", ["weights.safetensors", "weights.pt"])
def test_file_of_noise_or_no_file_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="no such file"):
        from_file(tmp_path / name)
    (tmp_path / name).write_bytes(b"noise")
    with pytest.raises(ValueError, match=name):
        from_file(tmp_path / name)


def test_download_that_fails_says_what_to_do_instead(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nowhere = dataclasses.replace(ResNet18_Weights.IMAGENET1K_V1.value, url="http://127.0.0.1:9/resnet18-f37072fd.pth")
    monkeypatch.setattr(ResNet18_Weights.IMAGENET1K_V1, "_value_", nowhere)
    monkeypatch.setattr(torch.hub, "_hub_dir", str(tmp_path))
    with pytest.raises(ValueError, match=r"--encoder\.backbone random"):
        load_initial_weights(drawn(0), EncoderConfig(backbone="imagenet"))
