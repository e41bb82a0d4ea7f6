"""DrQ-v2's learner: targets by hand, gradients it routes, noise it schedules, state it saves."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from slotfilm_dist.config import DdpgConfig, RunConfig
from slotfilm_dist.learning.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from slotfilm_dist.learning.ddpg import DdpgLearner
from slotfilm_dist.learning.learner import Learner
from slotfilm_dist.learning.off_policy import MAX_SKIPPED, METRICS_EVERY, TrainingDivergedError
from slotfilm_dist.messages import Observation, SampleBatch
from slotfilm_dist.nets.agent import build_actor, build_encoder
from slotfilm_dist.nets.deterministic_heads import LARGEST_ACTION, DeterministicActor
from slotfilm_dist.policy import AgentPolicy
from slotfilm_dist.variants import apply_variant

SIZE = 32


def config_of(variant: str = "drqv2", *, seed: int = 0, **ddpg: Any) -> RunConfig:
    base = apply_variant(variant, RunConfig(seed=seed))
    return replace(
        base,
        env=replace(base.env, image_size=SIZE),
        ddpg=replace(base.ddpg, **{"hidden": (16,)} | ddpg),
        encoder=replace(base.encoder, feature_dim=8),
        sac=replace(base.sac, reward_scale=1.0),
    )


def build(variant: str = "drqv2", *, seed: int = 0, **ddpg: Any) -> DdpgLearner:
    learner = Learner(config_of(variant, seed=seed, **ddpg), 7, torch.device("cpu"))
    learner.begin_rl(None)
    assert isinstance(learner.rl, DdpgLearner)
    return learner.rl


def batch_of(size: int = 6, seed: int = 0, **columns: Any) -> SampleBatch:
    rng = np.random.default_rng(seed)
    values: dict[str, Any] = {
        "action": rng.uniform(-1, 1, (size, 7)).astype(np.float32),
        "reward": rng.random(size, np.float32),
        "discount": np.full(size, 0.99**3, np.float32),
        "terminated": np.zeros(size, bool),
        "truncated": np.zeros(size, bool),
    }
    for prefix in ("", "next_"):
        values[prefix + "visual"] = rng.integers(0, 256, (size, SIZE, SIZE, 3), dtype=np.uint8)
        values[prefix + "proprio"] = rng.normal(size=(size, 35)).astype(np.float32)
        values[prefix + "goal"] = np.zeros((size, 3), np.float32)
    return SampleBatch(**values | columns)


def set_constant(critic: torch.nn.Module, *outputs: float) -> None:
    with torch.no_grad():
        critic.ensemble.weights[-1].zero_()
        critic.ensemble.biases[-1].copy_(torch.tensor(outputs).view(-1, 1, 1))


def measured(learner: DdpgLearner, batch: SampleBatch) -> dict[str, float]:
    learner.updates = METRICS_EVERY - 1
    learner.update(batch)
    return learner.metrics()


def copies(module: torch.nn.Module) -> list[torch.Tensor]:
    return [p.detach().clone() for p in module.parameters()]


def moved(before: list[torch.Tensor], module: torch.nn.Module) -> list[bool]:
    return [not torch.equal(a, b) for a, b in zip(before, module.parameters(), strict=True)]


def test_published_numbers_are_the_defaults() -> None:
    config = apply_variant("drqv2", RunConfig())
    ddpg = config.ddpg
    assert (ddpg.num_steps, ddpg.tau, ddpg.lr, ddpg.hidden) == (3, 0.01, 1e-4, (1024, 1024))
    assert (ddpg.first_std, ddpg.last_std, ddpg.std_steps, ddpg.noise_clip) == (1.0, 0.1, 500_000, 0.3)
    assert (ddpg.shift_px, ddpg.shift, config.encoder.feature_dim) == (4, "bilinear", 50)
    assert (config.sac.batch_size, config.schedule.updates_per_step, config.sac.gamma) == (256, 0.5, 0.99)
    assert config.schedule.total_steps == 2000 * 400
    assert DdpgConfig() == ddpg


def test_target_is_the_sum_of_rewards_and_the_discounted_smaller_target_critic() -> None:
    learner = build()
    set_constant(learner.critic, 0.0, 0.0)
    set_constant(learner.target_critic, 5.0, 3.0)
    reward = np.array([1, 2, 3, 4], np.float32)
    discount = np.array([0.9, 0.81, 0.729, 0.729], np.float32)
    ended = np.array([False, False, True, False])
    cut = np.array([False, False, False, True])
    found = measured(learner, batch_of(4, reward=reward, discount=discount, terminated=ended, truncated=cut))
    target = np.array([1 + 0.9 * 3, 2 + 0.81 * 3, 3, 4 + 0.729 * 3])
    assert found["learner_target_mean"] == pytest.approx(target.mean(), rel=1e-5)
    assert found["learner_critic_loss"] == pytest.approx(2 * (target**2).mean(), rel=1e-5)


def test_actor_climbs_the_smaller_critic_and_gets_no_entropy() -> None:
    learner = build(lr=1e-12)
    set_constant(learner.critic, 7.0, 4.0)
    assert measured(learner, batch_of())["learner_actor_loss"] == pytest.approx(-4.0, rel=1e-5)


def test_one_update_moves_every_network() -> None:
    learner = build()
    before = {name: copies(module) for name, module in learner.modules().items()}
    learner.update(batch_of())
    for name, module in learner.modules().items():
        assert any(moved(before[name], module)), name
    assert all(moved(before["encoder"], learner.modules()["encoder"]))
    assert all(moved(before["actor"], learner.actor))


def test_actor_loss_reaches_neither_encoder_nor_critics() -> None:
    """Critics that predict their targets exactly get no gradient of their own; what they have came from the actor."""
    learner, batch = build(), batch_of(terminated=np.ones(6, bool))
    with torch.no_grad():
        first = learner.critic.ensemble.weights[0]
        first[:, :8] = 0.0  # Q depends on the action alone, not on the picture
        for weight in learner.critic.ensemble.weights:
            weight[1] = weight[0]
        latent = learner._encode(batch.visual, batch.proprio, batch.goal)
        reward = learner.critic(latent, torch.from_numpy(batch.action))[0]
    learner.update(replace(batch, reward=reward.numpy()))
    for module in (learner.modules()["encoder"], learner.critic):
        assert all(p.grad is None or not p.grad.any() for p in module.parameters())
    assert all(p.grad is not None and p.grad.any() for p in learner.actor.parameters())


def test_target_critics_follow_at_their_rate_trunk_included() -> None:
    learner = build(tau=0.25)
    before = copies(learner.target_critic)
    learner.update(batch_of())
    for old, target, online in zip(
        before, learner.target_critic.parameters(), learner.critic.parameters(), strict=True
    ):
        assert torch.allclose(target, 0.75 * old + 0.25 * online, atol=1e-7)


def test_noise_falls_linearly_in_environment_steps_and_stays() -> None:
    learner = build(first_std=1.0, last_std=0.1, std_steps=400_000)
    schedule = learner.config.schedule
    for updates, expected in [(0, 1 - 0.9 / 4), (50_000, 1 - 0.9 / 2), (150_000, 0.1), (10**6, 0.1)]:
        learner.updates = updates
        assert learner.env_steps == 100_000 + 2 * updates
        assert learner.noise_std == pytest.approx(expected)
    assert schedule.updates_per_step == 0.5


def test_workers_get_the_noise_with_the_weights() -> None:
    learner = build()
    learner.updates = 100_000
    learner.update(batch_of())
    config = learner.config
    encoder = build_encoder(config)
    actor = build_actor(config, encoder, 7)
    policy = AgentPolicy(encoder, actor, np.random.SeedSequence(0))
    policy.load(learner.updates, learner.acting_arrays())
    assert isinstance(actor, DeterministicActor)
    assert actor.noise_std.item() == pytest.approx(1 - 0.9 * 300_000 / 500_000)
    observation = Observation(
        rgb=batch_of(500).visual,
        proprio=np.zeros((500, 35), np.float32),
        uv=np.zeros((500, 2, 2), np.float32),
        visible=np.zeros((500, 2), bool),
        goal=np.zeros((500, 3), np.float32),
    )
    with torch.no_grad():
        for parameter in actor.network.parameters():
            parameter.zero_()  # the mean is 0, so actions are the noise
    actions = policy.act(observation, policy.visual(observation))
    assert np.abs(actions).max() > 0.9, "noise in acting is not clipped to 0.3"
    inside = actions[np.abs(actions) < 0.9]
    assert np.abs(inside).mean() == pytest.approx(0.46 * (2 / np.pi) ** 0.5, rel=0.15)


def test_noise_of_the_losses_is_clipped_and_actions_stay_in_range() -> None:
    generator = torch.Generator().manual_seed(0)
    actor = DeterministicActor(4, 0, 7, feature_dim=4, hidden=(8,), generator=generator)
    latent, noise = torch.randn(200, 4, generator=generator), torch.randn(200, 7, generator=generator) * 3
    mode = actor.mode(latent)
    inside = mode.abs() < 0.6
    clipped = actor(latent, noise, 0.3)
    assert ((clipped - mode)[inside].abs() <= 0.3 + 1e-6).all()
    assert (clipped - mode)[inside].abs().max() > 0.29
    assert actor.explore(latent, 100 * noise).abs().max() <= LARGEST_ACTION
    # The clamp does not stop the gradient.
    (gradient,) = torch.autograd.grad(actor(latent, 100 * noise).sum(), actor.network.biases[-1])
    assert (gradient.abs() > 0).all()


def test_state_reaches_actor_and_critics_behind_the_trunk() -> None:
    learner, batch = build("drqv2_state"), batch_of()
    action = torch.from_numpy(batch.action)
    latent = learner.encoder(*(torch.from_numpy(x) for x in (batch.visual, batch.proprio, batch.goal)))
    other = latent.clone()
    other[:, -35:] += 1
    assert learner.actor.trunk(latent).shape == (6, 8 + 35)
    assert torch.equal(learner.actor.trunk(other)[:, :8], learner.actor.trunk(latent)[:, :8])
    assert not torch.equal(learner.actor.mode(other), learner.actor.mode(latent))
    assert not torch.equal(learner.critic(other, action), learner.critic(latent, action))
    learner.update(batch)


@pytest.mark.parametrize("shift", ["bilinear", "whole"])
def test_loss_falls_on_a_fixed_batch(shift: str) -> None:
    learner = build(lr=3e-3, shift=shift, tau=0.01)
    reward = np.linspace(-1, 1, 6, dtype=np.float32)
    batch = batch_of(reward=reward, terminated=np.ones(6, bool))
    first = measured(learner, batch)["learner_critic_loss"]
    for _ in range(120):
        learner.update(batch)
    assert learner.metrics()["learner_critic_loss"] < 0.2 * first


def test_same_seed_gives_the_same_updates_and_another_seed_others() -> None:
    a, b, c = build(), build(), build(seed=1)
    for learner in (a, b, c):
        learner.update(batch_of())
    same, other = (x.save()["tensors"] for x in (b, c))
    tensors = a.save()["tensors"]
    assert all(torch.equal(tensors[name], same[name]) for name in tensors)
    assert not torch.equal(tensors["actor.trunk.projection.weight"], other["actor.trunk.projection.weight"])


def test_checkpoint_continues_bit_for_bit(tmp_path) -> None:
    config = config_of("drqv2_state")
    learner = Learner(config, 7, torch.device("cpu"))
    learner.begin_rl(None)
    for seed in range(3):
        learner.update(batch_of(seed=seed))
    saved: Checkpoint = learner.checkpoint({"env_steps": 5})
    write_checkpoint(tmp_path / "c", saved)
    fresh = Learner(config, 7, torch.device("cpu"))
    fresh.load_checkpoint(read_checkpoint(tmp_path / "c", saved.config_hash))
    assert fresh.updates == 3
    for seed in range(3, 6):
        learner.update(batch_of(seed=seed))
        fresh.update(batch_of(seed=seed))
    a, b = learner.checkpoint({}).tensors, fresh.checkpoint({}).tensors
    assert a.keys() == b.keys()
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_checkpoint_of_sac_is_refused() -> None:
    saved = build().save()
    lacking = {name: value for name, value in saved["tensors"].items() if name != "target_critic.trunk.norm.bias"}
    with pytest.raises(ValueError, match=r"target_critic.trunk.norm.bias is missing"):
        build().load({**saved, "tensors": lacking})


def test_losses_that_are_not_finite_are_skipped_and_then_stop_the_learner() -> None:
    learner = build()
    before = learner.save()["tensors"]
    broken = batch_of(reward=np.full(6, np.nan, np.float32))
    for _ in range(MAX_SKIPPED - 1):
        learner.update(broken)
    assert (learner.updates, learner.skipped_updates) == (0, MAX_SKIPPED - 1)
    after = learner.save()["tensors"]
    assert all(torch.equal(before[n], after[n]) for n in before if n != "noise_state")
    with pytest.raises(TrainingDivergedError, match=r"lower ddpg.lr"):
        learner.update(broken)


def test_pixel_learner_needs_no_pretraining_and_stores_pictures() -> None:
    learner = Learner(config_of(), 7, torch.device("cpu"))
    learner.begin_rl(None)
    assert not learner.config.pretrains
    schema = learner.schema()
    assert (schema.visual_kind, schema.visual_shape, schema.backbone_hash) == ("rgb", (SIZE, SIZE, 3), "")
