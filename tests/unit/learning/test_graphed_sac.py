"""The update as a CUDA graph against the plain one: on a CPU the same computation without a graph."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from slotfilm_dist.config import EncoderConfig, RunConfig, RuntimeConfig, SacConfig
from slotfilm_dist.learning.graphed_sac import SETTLE_EVERY, GraphedSac
from slotfilm_dist.learning.off_policy import MAX_SKIPPED, TrainingDivergedError
from slotfilm_dist.learning.sac import SacLearner
from slotfilm_dist.messages import SampleBatch
from slotfilm_dist.nets.encoder import SlotFusionEncoder

GPU = pytest.param("cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")])
DEVICES = pytest.mark.parametrize("device", ["cpu", GPU])
SIZE = 8


def build(kind: type[SacLearner], device: str, *, fusion: str = "film_tanh", **sac: object) -> SacLearner:
    encoder = EncoderConfig(backbone="random", fusion=fusion)
    config = RunConfig(encoder=encoder, sac=SacConfig(**{"hidden": (16, 16), "batch_size": SIZE} | sac))
    made = SlotFusionEncoder(encoder, config.obs, 128, seed=3)
    made.freeze_backbone()
    made.to(device).eval()
    return kind(config, made, 7, np.random.SeedSequence(0), torch.device(device))


def batch_of(seed: int, *, seeing: bool = True) -> SampleBatch:
    rng = np.random.default_rng(seed)
    columns = {
        "action": rng.uniform(-1, 1, (SIZE, 7)).astype(np.float32),
        "reward": rng.random(SIZE, np.float32),
        "discount": np.full(SIZE, 0.99, np.float32),
        "terminated": rng.random(SIZE) < 0.2,
        "truncated": rng.random(SIZE) < 0.2,
    }
    for prefix in ("", "next_"):
        shape = (SIZE, 64, 42) if seeing else (SIZE, 0)
        columns[prefix + "visual"] = rng.normal(size=shape).astype(np.float16)
        columns[prefix + "proprio"] = rng.normal(size=(SIZE, 35)).astype(np.float32)
        columns[prefix + "goal"] = np.concatenate((rng.random((SIZE, 2)), np.ones((SIZE, 1))), 1).astype(np.float32)
    return SampleBatch(**columns)


def broken(batch: SampleBatch) -> SampleBatch:
    return replace(batch, reward=np.full(SIZE, np.nan, np.float32))


def break_it(learner: SacLearner, num_updates: int) -> None:
    for i in range(num_updates):
        learner.update(broken(batch_of(i)))


def tensors(learner: SacLearner) -> dict[str, torch.Tensor]:
    return {k: v.double() for k, v in learner.save()["tensors"].items() if k != "noise_state"}


def assert_close(a: SacLearner, b: SacLearner, tolerance: float) -> None:
    ours, theirs = tensors(a), tensors(b)
    assert ours.keys() == theirs.keys()
    for name in ours:
        assert torch.allclose(ours[name], theirs[name], rtol=tolerance, atol=tolerance), name


@DEVICES
@pytest.mark.parametrize("mode", ["fixed", "annealed", "auto"])
@pytest.mark.parametrize("fusion", ["film_tanh", "state_only"])
def test_updates_equal_those_without_a_graph(device: str, mode: str, fusion: str) -> None:
    options = {"temperature_mode": mode, "fusion": fusion, "grad_clip": 1.0, "critic_norm": "layer"}
    graphed, plain = (build(kind, device, **options) for kind in (GraphedSac, SacLearner))
    for i in range(3 * SETTLE_EVERY):
        batch = batch_of(i, seeing=fusion != "state_only")
        graphed.update(batch)
        plain.update(batch)
    assert graphed.updates == plain.updates == 3 * SETTLE_EVERY
    assert_close(graphed, plain, 1e-5 if device == "cpu" else 2e-3)
    ours, theirs = graphed.metrics(), plain.metrics()
    assert ours == pytest.approx(theirs, rel=1e-4 if device == "cpu" else 2e-2, abs=1e-4)


@DEVICES
def test_update_that_is_not_finite_changes_nothing_and_is_not_counted(device: str) -> None:
    graphed, plain = (build(kind, device) for kind in (GraphedSac, SacLearner))
    for i in range(20):
        batch = batch_of(i)
        for learner in (graphed, plain):
            learner.update(broken(batch) if i in (0, 4, 5, 13) else batch)
    graphed.settle()
    assert graphed.updates == plain.updates == 16
    assert graphed.skipped_updates == plain.skipped_updates == 4
    # The noise of a skipped update is drawn in the one and not in the other.
    assert all(bool(value.isfinite().all()) for value in tensors(graphed).values())
    before = tensors(graphed)
    graphed.update(broken(batch_of(0)))
    graphed.settle()
    after = tensors(graphed)
    assert all(torch.equal(before[name], after[name]) for name in before)


@DEVICES
def test_divergence_is_raised_once_and_counted(device: str) -> None:
    learner = build(GraphedSac, device)
    with pytest.raises(TrainingDivergedError, match="not finite"):
        break_it(learner, MAX_SKIPPED + SETTLE_EVERY)
    assert learner.updates == 0
    assert learner.skipped_updates >= MAX_SKIPPED
    for i in range(SETTLE_EVERY):
        learner.update(batch_of(i))
    learner.settle()
    assert learner.updates == SETTLE_EVERY


@DEVICES
def test_few_failures_in_a_row_are_remembered_across_readings(device: str) -> None:
    learner = build(GraphedSac, device)
    break_it(learner, MAX_SKIPPED - 1)
    learner.settle()
    with pytest.raises(TrainingDivergedError):
        break_it(learner, SETTLE_EVERY)


@DEVICES
def test_saved_and_loaded_it_goes_on_the_same(device: str) -> None:
    first, second = (build(GraphedSac, device, temperature_mode="auto") for _ in range(2))
    for i in range(12):
        first.update(batch_of(i))
    second.update(batch_of(99))
    second.load(first.save())
    for i in range(12, 24):
        first.update(batch_of(i))
        second.update(batch_of(i))
    assert_close(first, second, 1e-6 if device == "cpu" else 1e-3)


@DEVICES
def test_changed_rates_count_from_the_next_update(device: str) -> None:
    learner = build(GraphedSac, device)
    for i in range(8):
        learner.update(batch_of(i))
    learner.scale_rates(0.0)
    before = {name: p.detach().clone() for name, p in learner.critic.named_parameters()}
    for i in range(8):
        learner.update(batch_of(i))
    assert all(torch.equal(before[name], p) for name, p in learner.critic.named_parameters())


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++, a program of ops/test-packages.txt")
def test_compiled_networks_update_the_same() -> None:
    config = RunConfig(
        encoder=EncoderConfig(backbone="random"),
        sac=SacConfig(hidden=(16, 16), batch_size=SIZE),
        runtime=RuntimeConfig(compiled=True),
    )
    made = SlotFusionEncoder(config.encoder, config.obs, 128, seed=3)
    made.freeze_backbone()
    compiled = GraphedSac(config, made.eval(), 7, np.random.SeedSequence(0), torch.device("cpu"))
    plain = build(SacLearner, "cpu")
    for i in range(4):
        compiled.update(batch_of(i))
        plain.update(batch_of(i))
    assert_close(compiled, plain, 1e-4)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize(("ours", "theirs"), [("cuda", "cpu"), ("cpu", "cuda")])
def test_checkpoint_moves_between_gpu_and_cpu(ours: str, theirs: str) -> None:
    first = build(GraphedSac, ours)
    for i in range(8):
        first.update(batch_of(i))
    second = build(GraphedSac, theirs)
    second.load(first.save())
    assert second.updates == 8
    assert_close(first, second, 1e-6)
    second.update(batch_of(8))


def test_random_stream_of_a_gpu_becomes_one_of_the_cpu() -> None:
    first, second = (build(GraphedSac, "cpu") for _ in range(2))
    saved = first.save()
    saved["tensors"]["noise_state"] = torch.arange(16, dtype=torch.uint8)
    first.load(saved)
    second.load(saved)
    first.update(batch_of(0))
    second.update(batch_of(0))
    assert_close(first, second, 0.0)
