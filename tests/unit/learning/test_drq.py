"""DrQ-v1 on SAC: averages over shifted views, and what of it the actor sees."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from slotfilm_dist.config import RunConfig
from slotfilm_dist.learning.augment import random_shift
from slotfilm_dist.learning.learner import Learner
from slotfilm_dist.learning.off_policy import METRICS_EVERY
from slotfilm_dist.learning.sac import SacLearner
from slotfilm_dist.messages import SampleBatch
from slotfilm_dist.variants import apply_variant

SIZE = 32


def build(variant: str = "drq", *, views: int | None = None, **sac: Any) -> SacLearner:
    base = apply_variant(variant, RunConfig())
    sac = {"hidden": (16,), "reward_scale": 1.0} | sac | ({} if views is None else {"augment_views": views})
    config = replace(base, env=replace(base.env, image_size=SIZE), sac=replace(base.sac, **sac))
    learner = Learner(config, 7, torch.device("cpu"))
    learner.begin_rl(None)
    assert isinstance(learner.rl, SacLearner)
    return learner.rl


def batch_of(size: int = 4, seed: int = 0, **columns: Any) -> SampleBatch:
    rng = np.random.default_rng(seed)
    values: dict[str, Any] = {
        "action": rng.uniform(-1, 1, (size, 7)).astype(np.float32),
        "reward": rng.random(size, np.float32),
        "discount": np.full(size, 0.99, np.float32),
        "terminated": np.zeros(size, bool),
        "truncated": np.zeros(size, bool),
    }
    for prefix in ("", "next_"):
        values[prefix + "visual"] = rng.integers(0, 256, (size, SIZE, SIZE, 3), dtype=np.uint8)
        values[prefix + "proprio"] = rng.normal(size=(size, 35)).astype(np.float32)
        values[prefix + "goal"] = np.zeros((size, 3), np.float32)
    return SampleBatch(**values | columns)


@torch.no_grad()
def views_of(
    learner: SacLearner, pictures: np.ndarray, state: np.ndarray, noise: torch.Generator
) -> list[torch.Tensor]:
    """Latents of as many shifted views as the learner takes, drawn as it draws them."""
    goal = torch.zeros(len(state), 3)
    shifted = [random_shift(torch.from_numpy(pictures), 4, noise) for _ in range(learner.config.sac.augment_views)]
    return [learner.encoder(view, torch.from_numpy(state), goal) for view in shifted]


@pytest.mark.parametrize("views", [1, 2, 3])
def test_target_and_loss_are_averages_over_the_views(views: int) -> None:
    learner, batch = build(views=views), batch_of()
    noise = torch.Generator()
    noise.set_state(learner._noise.get_state())
    now = views_of(learner, batch.visual, batch.proprio, noise)
    after = views_of(learner, batch.next_visual, batch.next_proprio, noise)
    with torch.no_grad():
        following = torch.stack([learner.target_value(latent) for latent in after]).mean(0)
        target = torch.from_numpy(batch.reward) + 0.99 * following
        q = torch.stack([learner.critic(latent, torch.from_numpy(batch.action)) for latent in now])
        loss = 0.5 * (q - target).square().mean(dim=(0, 2)).sum()
        if views > 1:
            assert not torch.allclose(q[0], q[1]), "the views do not differ"
    learner.updates = METRICS_EVERY - 1
    learner.update(batch)
    assert learner.metrics()["learner_critic_loss"] == pytest.approx(loss.item(), rel=1e-5)
    assert learner.metrics()["learner_target_mean"] == pytest.approx(target.mean().item(), rel=1e-5)


def test_without_views_pictures_are_seen_as_they_are() -> None:
    learner, batch = build("cnn"), batch_of()
    state = learner._noise.get_state()
    with torch.no_grad():
        given = [torch.from_numpy(x) for x in (batch.visual, batch.proprio, batch.goal)]
        seen, plain = learner._encode(*given), learner.encoder(*given)
    assert torch.equal(seen, plain)
    assert torch.equal(learner._noise.get_state(), state)


@pytest.mark.parametrize("variant", ["cnn", "drq", "cnn_state", "drq_state"])
def test_critics_alone_train_the_encoder(variant: str) -> None:
    learner, batch = build(variant), batch_of(terminated=np.ones(4, bool))
    encoder = learner.modules()["encoder"]
    before = [p.detach().clone() for p in encoder.parameters()]
    learner.update(batch)
    assert all(not torch.equal(a, b) for a, b in zip(before, encoder.parameters(), strict=True))


@pytest.mark.parametrize("variant", ["cnn", "drq", "cnn_state", "drq_state"])
def test_actor_and_value_give_the_encoder_no_gradient(variant: str) -> None:
    """Critics that say 0 and are right have no gradient of their own, whatever actor and value network have."""
    learner, batch = build(variant), batch_of(terminated=np.ones(4, bool), reward=np.zeros(4, np.float32))
    with torch.no_grad():
        learner.critic.ensemble.weights[-1].zero_()
        learner.critic.ensemble.biases[-1].zero_()
    learner.update(batch)
    assert all(p.grad is None or not p.grad.any() for p in learner.modules()["encoder"].parameters())
    for module in (learner.actor, learner.value):
        assert any(p.grad is not None and p.grad.any() for p in module.parameters())


def test_encoder_learns_at_the_critics_rate() -> None:
    for name in ("cnn", "drq"):
        lr = apply_variant(name, RunConfig()).lr
        assert lr.fusion == lr.critic_value == 1e-3


@pytest.mark.parametrize("variant", ["cnn", "drq"])
def test_loss_falls_on_a_fixed_batch(variant: str) -> None:
    learner = build(variant)
    batch = batch_of(reward=np.linspace(-1, 1, 4, dtype=np.float32), terminated=np.ones(4, bool))
    learner.updates = METRICS_EVERY - 1
    learner.update(batch)
    first = learner.metrics()["learner_critic_loss"]
    for _ in range(120):
        learner.update(batch)
    assert learner.metrics()["learner_critic_loss"] < 0.2 * first


def test_saved_state_continues_bit_for_bit() -> None:
    learner, other = build(), build()
    for seed in range(2):
        learner.update(batch_of(seed=seed))
    other.load(learner.save())
    for seed in range(2, 4):
        learner.update(batch_of(seed=seed))
        other.update(batch_of(seed=seed))
    a, b = learner.save()["tensors"], other.save()["tensors"]
    assert all(torch.equal(a[name], b[name]) for name in a)
