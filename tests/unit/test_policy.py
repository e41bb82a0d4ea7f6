"""Who acts: the random policy, and the agent with and without noise."""

import numpy as np
import torch

from slotfilm_dist.config import EncoderConfig, ObsConfig
from slotfilm_dist.messages import Observation
from slotfilm_dist.nets.encoder import SlotFusionEncoder
from slotfilm_dist.nets.policy_heads import Actor
from slotfilm_dist.policy import AgentPolicy, RandomPolicy


def observation(seed: int = 0, *, camera: bool = False, count: int = 3) -> Observation:
    rng = np.random.default_rng(seed)
    return Observation(
        rgb=rng.integers(0, 256, (count, 128, 128, 3), dtype=np.uint8) if camera else None,
        proprio=rng.normal(size=(count, 35)).astype(np.float32),
        uv=np.zeros((count, 2, 2), np.float32),
        visible=np.zeros((count, 2), bool),
        goal=np.zeros((count, 3), np.float32),
    )


def agent(seed: int = 0, *, deterministic: bool = False, camera: bool = False) -> AgentPolicy:
    config = EncoderConfig(fusion="film_tanh" if camera else "state_only", backbone="random")
    encoder = SlotFusionEncoder(config, ObsConfig(), 128, seed=1)
    encoder.freeze_backbone()
    actor = Actor(encoder.latent_dim, 7, (16,), generator=torch.Generator().manual_seed(2))
    return AgentPolicy(encoder.eval(), actor, np.random.SeedSequence(seed), deterministic=deterministic)


def act(policy: AgentPolicy | RandomPolicy, seen: Observation) -> np.ndarray:
    return policy.act(seen, policy.visual(seen))


def test_random_actions_are_uniform_and_follow_from_the_seed() -> None:
    seen = observation(count=5000)
    actions = act(RandomPolicy(7, np.random.SeedSequence(0)), seen)
    assert actions.shape == (5000, 7)
    assert actions.dtype == np.float32
    assert np.abs(actions).max() <= 1
    assert np.allclose(actions.mean(0), 0, atol=0.05)
    assert np.allclose(actions.std(0), 1 / np.sqrt(3), atol=0.02)
    assert np.array_equal(actions, act(RandomPolicy(7, np.random.SeedSequence(0)), seen))
    assert not np.array_equal(actions, act(RandomPolicy(7, np.random.SeedSequence(1)), seen))


def test_evaluation_acts_by_tanh_of_the_mean_and_draws_nothing() -> None:
    policy, seen = agent(deterministic=True), observation()
    before = policy.save_noise()
    found = act(policy, seen)
    mean, _ = policy.actor.distribution(torch.from_numpy(seen.proprio))
    assert np.allclose(found, torch.tanh(mean).detach().numpy(), atol=1e-6)
    assert np.array_equal(found, act(agent(seed=5, deterministic=True), seen))
    assert policy.save_noise() == before


def test_exploring_actions_differ_from_call_to_call_and_follow_from_the_seed() -> None:
    policy, seen = agent(), observation()
    first, second = act(policy, seen), act(policy, seen)
    assert not np.array_equal(first, second)
    assert np.array_equal(first, act(agent(), seen))
    assert not np.array_equal(first, act(agent(seed=1), seen))


def test_saved_noise_continues() -> None:
    policy, seen = agent(), observation()
    act(policy, seen)
    other = agent(seed=9)
    other.load_noise(policy.save_noise())
    assert np.array_equal(act(policy, seen), act(other, seen))


def test_agent_stores_half_precision_tokens_of_uint8_pictures_and_names_their_backbone() -> None:
    policy, seen = agent(camera=True), observation(camera=True)
    visual = policy.visual(seen)
    assert (visual.dtype, visual.shape) == (np.float16, (3, 64, 42))
    assert seen.rgb is not None
    assert np.array_equal(visual, policy.encoder.to_visual(torch.from_numpy(seen.rgb)).numpy())
    assert policy.backbone_hash == policy.encoder.backbone_hash() != ""


def test_agent_without_a_camera_stores_nothing_of_it() -> None:
    assert agent().visual(observation(camera=True)).shape == (3, 0)
    assert agent().backbone_hash == ""
    assert RandomPolicy(7, np.random.SeedSequence(0)).visual(observation()).shape == (3, 0)


def test_published_weights_are_taken_over_with_their_version() -> None:
    policy, source, seen = agent(deterministic=True), agent(deterministic=True), observation()
    with torch.no_grad():
        for parameter in source.actor.parameters():
            parameter.add_(0.1)
        source.encoder.set_state_statistics(torch.ones(35), torch.full((35,), 2.0))
    arrays = {f"actor.{k}": v.numpy() for k, v in source.actor.state_dict().items()}
    arrays |= {f"encoder.{k}": v for k, v in source.encoder.acting_state().items()}
    assert not np.array_equal(act(policy, seen), act(source, seen))
    policy.load(17, arrays)
    assert policy.version == 17
    assert np.array_equal(act(policy, seen), act(source, seen))
