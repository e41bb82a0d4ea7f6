"""The SAC learner: values it converges to, gradients it routes, state it saves."""

import copy
import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from slotfilm_dist.config import EncoderConfig, LrConfig, RunConfig, SacConfig
from slotfilm_dist.learning import losses
from slotfilm_dist.learning.off_policy import MAX_SKIPPED, METRICS_EVERY, TrainingDivergedError
from slotfilm_dist.learning.sac import SacLearner
from slotfilm_dist.messages import SampleBatch
from slotfilm_dist.nets.encoder import SlotFusionEncoder

STATE_ONLY = EncoderConfig(fusion="state_only")
SEEING = EncoderConfig(backbone="random")
TOKENS = (64, 42)


def build(encoder: EncoderConfig = STATE_ONLY, *, seed: int = 0, lr: LrConfig | None = None, **sac: Any) -> SacLearner:
    config = RunConfig(encoder=encoder, lr=lr or LrConfig(), sac=SacConfig(**{"hidden": (16,), "batch_size": 8} | sac))
    made = SlotFusionEncoder(encoder, config.obs, 128, seed=3)
    if not config.sac.end_to_end:
        made.freeze_backbone()
    return SacLearner(config, made.eval(), 7, np.random.SeedSequence(seed), torch.device("cpu"))


def batch_of(encoder: EncoderConfig = STATE_ONLY, size: int = 8, seed: int = 0, **columns: Any) -> SampleBatch:
    rng = np.random.default_rng(seed)
    shape = (size, *TOKENS) if encoder.uses_image else (size, 0)
    values: dict[str, Any] = {
        "action": rng.uniform(-1, 1, (size, 7)).astype(np.float32),
        "reward": rng.random(size, np.float32),
        "discount": np.full(size, 0.99, np.float32),
        "terminated": np.zeros(size, bool),
        "truncated": np.zeros(size, bool),
    }
    for prefix in ("", "next_"):
        values[prefix + "visual"] = rng.normal(size=shape).astype(np.float16)
        values[prefix + "proprio"] = rng.normal(size=(size, 35)).astype(np.float32)
        values[prefix + "goal"] = np.concatenate((rng.random((size, 2)), np.ones((size, 1))), 1).astype(np.float32)
    return SampleBatch(**values | columns)


def measured(learner: SacLearner, batch: SampleBatch) -> dict[str, float]:
    """Metrics of the very next update."""
    learner.updates = METRICS_EVERY - 1
    learner.update(batch)
    return learner.metrics()


def tensors(learner: SacLearner) -> dict[str, torch.Tensor]:
    return learner.save()["tensors"]


def set_constant(network: torch.nn.Module, *outputs: float) -> None:
    """Make every member of an ensemble say one number everywhere."""
    with torch.no_grad():
        network.ensemble.weights[-1].zero_()
        network.ensemble.biases[-1].copy_(torch.tensor(outputs).view(-1, 1, 1))


@pytest.mark.parametrize(
    ("mode", "ending", "expected"),
    [
        ("on_truncation", "truncated", 5.0),
        ("on_truncation", "terminated", 1.0),
        ("always", "terminated", 5.0),
        ("never", "truncated", 1.0),
    ],
)
def test_value_of_a_single_state_with_reward_1(mode: str, ending: str, expected: float) -> None:
    """V = 1 / (1 - gamma) where the last step bootstraps, 1 where it does not; entropy counts next to nothing."""
    learner = build(
        gamma=0.8, tau=0.1, reward_scale=1.0, temperature=1e-6, bootstrap=mode, lr=LrConfig(critic_value=1e-2)
    )
    state = np.ones((8, 35), np.float32)
    fixed = {"proprio": state, "next_proprio": state, "reward": np.ones(8, np.float32)}
    for update in range(250):
        learner.update(batch_of(seed=update, **fixed, **{ending: np.ones(8, bool)}))
    found = learner.metrics()
    assert found["learner_target_mean"] == pytest.approx(expected, abs=0.15)
    assert found["learner_q_mean"] == pytest.approx(expected, abs=0.25)
    assert learner.value(torch.ones(1, 35)).item() == pytest.approx(expected, abs=0.25)


def test_critic_target_reads_the_target_network_at_the_next_state() -> None:
    learner = build(gamma=0.9, reward_scale=10.0)
    set_constant(learner.value, 100.0)
    with torch.no_grad():
        for parameter in learner.target_value.parameters():
            parameter.zero_()
        learner.target_value.ensemble.weights[0][0, 0, 0] = 1.0
        learner.target_value.ensemble.weights[1][0, 0, 0] = 1.0
    state, following = np.zeros((8, 35), np.float32), np.zeros((8, 35), np.float32)
    state[:, 0], following[:, 0] = 50.0, 4.0
    batch = batch_of(reward=np.full(8, 0.5, np.float32), proprio=state, next_proprio=following)
    assert measured(learner, batch)["learner_target_mean"] == pytest.approx(10 * 0.5 + 0.9 * 4.0)


def test_value_and_actor_follow_the_smaller_critic() -> None:
    learner = build(temperature=1e-9, lr=LrConfig(critic_value=1e-12))
    set_constant(learner.critic, 5.0, 3.0)
    set_constant(learner.value, 0.0)
    found = measured(learner, batch_of())
    assert found["learner_value_loss"] == pytest.approx(0.5 * 3.0**2, rel=1e-5)
    assert found["learner_actor_loss"] == pytest.approx(-3.0, rel=1e-5)


def test_value_target_uses_fresh_actions_of_the_policy() -> None:
    """Q is the first action plus one; replay holds 1 there while the policy says -1."""
    learner = build(hidden=(1,), temperature=1e-9, lr=LrConfig(critic_value=1e-12), log_std_min=-20.0)
    with torch.no_grad():
        first, second = learner.critic.ensemble.weights
        first.zero_()
        first[:, 35] = 1.0
        second.fill_(1.0)
        learner.critic.ensemble.biases[0].fill_(1.0)
        learner.critic.ensemble.biases[1].zero_()
        learner.actor.network.weights[-1].zero_()
        learner.actor.network.biases[-1].fill_(-20.0)
    set_constant(learner.value, 0.0)
    found = measured(learner, batch_of(action=np.ones((8, 7), np.float32)))
    assert found["learner_q_mean"] == pytest.approx(2.0)
    assert found["learner_value_loss"] == pytest.approx(0.0, abs=1e-6)


def test_entropy_bonus_enters_the_value_target() -> None:
    learner = build(temperature=0.5, lr=LrConfig(critic_value=1e-12, actor=1e-12))
    set_constant(learner.critic, 0.0, 0.0)
    set_constant(learner.value, 0.0)
    found = measured(learner, batch_of())
    # One sample for each state: E[(alpha log pi)^2] is at least (alpha E[log pi])^2, and the actor's loss is linear.
    assert found["learner_actor_loss"] == pytest.approx(-0.5 * found["learner_entropy_nats"], rel=1e-4)
    assert found["learner_value_loss"] >= 0.5 * (0.5 * found["learner_entropy_nats"]) ** 2


def test_reward_scale_10_with_temperature_1_is_scale_1_with_temperature_one_tenth() -> None:
    # Adam's steps do not scale with the loss, so the critics stand still between the three losses.
    still = LrConfig(critic_value=1e-12)
    large = build(reward_scale=10.0, temperature=1.0, lr=still)
    small = build(reward_scale=1.0, temperature=0.1, lr=still)
    with torch.no_grad():
        for network in (large.critic, large.value, large.target_value):
            network.ensemble.weights[-1].mul_(10)
            network.ensemble.biases[-1].mul_(10)
    a, b = measured(large, batch_of()), measured(small, batch_of())
    assert a["learner_critic_loss"] == pytest.approx(100 * b["learner_critic_loss"], rel=1e-3)
    assert a["learner_target_mean"] == pytest.approx(10 * b["learner_target_mean"], rel=1e-3)
    assert a["learner_value_loss"] == pytest.approx(100 * b["learner_value_loss"], rel=1e-3)
    assert a["learner_actor_loss"] == pytest.approx(10 * b["learner_actor_loss"], rel=1e-3)


@pytest.mark.parametrize("fusion", ["film_tanh", "concat_proj", "none"])
def test_encoder_gets_the_critics_gradient_and_nothing_else(fusion: str) -> None:
    config = replace(SEEING, fusion=fusion, goal=True)
    learner, batch = build(config), batch_of(config)
    reference = copy.deepcopy((learner.encoder, learner.critic, learner.target_value))
    learner.update(batch)

    encoder, critic, target_value = reference
    names = ("visual", "proprio", "goal")
    latent = encoder(*(torch.from_numpy(getattr(batch, name)) for name in names))
    with torch.no_grad():
        following = encoder(*(torch.from_numpy(getattr(batch, "next_" + name)) for name in names))
        target = 10.0 * torch.from_numpy(batch.reward) + 0.99 * target_value(following)
    q = critic(latent, torch.from_numpy(batch.action))
    (0.5 * ((q[0] - target) ** 2).mean() + 0.5 * ((q[1] - target) ** 2).mean()).backward()

    trained = [*learner.encoder.fusion_parameters(), *learner.encoder.gate_parameters(), *learner.critic.parameters()]
    expected = [*encoder.fusion_parameters(), *encoder.gate_parameters(), *critic.parameters()]
    for found, wanted in zip(trained, expected, strict=True):
        assert (found.grad is None) == (wanted.grad is None)
        if found.grad is not None and wanted.grad is not None:
            assert torch.allclose(found.grad, wanted.grad, rtol=1e-4, atol=1e-7)
    assert sum(float(p.grad.abs().sum()) for p in learner.encoder.gate_parameters() if p.grad is not None) > 0
    assert sum(float(p.grad.abs().sum()) for p in learner.encoder.fusion_parameters() if p.grad is not None) > 0


def test_target_network_gets_no_gradient_and_moves_by_tau_after_the_update() -> None:
    learner = build(tau=0.25)
    before = [p.clone() for p in learner.target_value.parameters()]
    learner.update(batch_of())
    for old, target, online in zip(before, learner.target_value.parameters(), learner.value.parameters(), strict=True):
        assert target.grad is None
        assert torch.allclose(target, 0.75 * old + 0.25 * online, atol=1e-7)
        assert not torch.equal(old, online)


def test_frozen_backbone_heads_and_batchnorm_statistics_stay_as_they_are() -> None:
    learner = build(SEEING)
    learner.encoder.train()
    before = {name: value.clone() for name, value in learner.encoder.state_dict().items()}
    for update in range(3):
        learner.update(batch_of(SEEING, seed=update))
    changed = {n for n, value in learner.encoder.state_dict().items() if not torch.equal(value, before[n])}
    assert changed
    assert not [n for n in changed if n.startswith(("perception.backbone", "perception.projection"))]
    assert not [n for n in changed if "head" in n or "running" in n]


def test_end_to_end_trains_the_backbone_on_uint8_pictures_and_leaves_batchnorm_statistics() -> None:
    config = replace(SEEING, backbone="random")
    learner = build(config, end_to_end=True)
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 256, (2, 2, 128, 128, 3), dtype=np.uint8)
    before = {name: value.clone() for name, value in learner.encoder.state_dict().items()}
    learner.update(batch_of(config, size=2, visual=pictures[0], next_visual=pictures[1]))
    changed = {n for n, value in learner.encoder.state_dict().items() if not torch.equal(value, before[n])}
    assert "perception.backbone.trunk.conv1.weight" in changed
    assert "perception.projection.weight" in changed
    assert not [n for n in changed if "running" in n or "num_batches" in n]


def largest_move(before: Iterable[torch.Tensor], after: Iterable[torch.Tensor]) -> float:
    return max(float((a.detach() - b).abs().max()) for a, b in zip(after, before, strict=True))


def test_each_group_of_parameters_has_its_own_learning_rate() -> None:
    """Adam's first step moves every parameter with a gradient by the learning rate."""
    lr = LrConfig(actor=1e-4, critic_value=2e-4, fusion=3e-4, goal_gate=5e-4, backbone=7e-4, temperature=9e-4)
    config = replace(SEEING, goal=True)
    learner = build(config, lr=lr, end_to_end=True, temperature_mode="auto")
    encoder = learner.encoder
    groups = {
        "actor": (list(learner.actor.parameters()), lr.actor),
        "critic": (list(learner.critic.parameters()), lr.critic_value),
        "value": (list(learner.value.parameters()), lr.critic_value),
        "fusion": (encoder.fusion_parameters(), lr.fusion),
        "gate": (encoder.gate_parameters(), lr.goal_gate),
        "backbone": (encoder.backbone_parameters(), lr.backbone),
        "temperature": ([learner.log_temperature], lr.temperature),
    }
    before = {name: [p.detach().clone() for p in parameters] for name, (parameters, _) in groups.items()}
    pictures = np.random.default_rng(0).integers(0, 256, (2, 2, 128, 128, 3), dtype=np.uint8)
    learner.update(batch_of(config, size=2, visual=pictures[0], next_visual=pictures[1]))
    moved = {name: largest_move(before[name], parameters) for name, (parameters, _) in groups.items()}
    assert moved == {name: pytest.approx(rate, rel=0.02) for name, (_, rate) in groups.items()}


def test_fixed_temperature_stays_and_automatic_one_moves_toward_the_target_entropy() -> None:
    fixed = build(temperature=0.2)
    fixed.update(batch_of())
    assert fixed.log_temperature.item() == pytest.approx(math.log(0.2))
    for target, rises in ((50.0, True), (-50.0, False)):
        learner = build(temperature=0.2, temperature_mode="auto", target_entropy=target)
        learner.update(batch_of())
        assert (learner.log_temperature.item() > math.log(0.2)) == rises


def test_gradient_clip_bounds_the_norm_over_critics_and_encoder() -> None:
    free, clipped = build(SEEING), build(SEEING, grad_clip=0.01)
    batch = batch_of(SEEING)
    norms = [
        math.hypot(found["learner_critic_gradient_norm"], found["learner_encoder_gradient_norm"])
        for found in (measured(free, batch), measured(clipped, batch))
    ]
    assert norms[0] > 0.1
    assert norms[1] == pytest.approx(0.01, rel=1e-3)


def test_update_that_is_not_finite_is_skipped_and_counted() -> None:
    learner = build(SEEING)
    learner.update(batch_of(SEEING))
    before = tensors(learner)
    learner.update(batch_of(SEEING, reward=np.full(8, np.nan, np.float32)))
    after = tensors(learner)
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert (learner.updates, learner.metrics()["learner_nonfinite_total"]) == (1, 1)


def test_update_whose_gradient_overflows_though_its_loss_is_finite_is_skipped() -> None:
    learner = build(hidden=(256, 256))
    batch = batch_of(reward=np.full(8, 6e17, np.float32))
    before = tensors(learner)
    with torch.no_grad():
        target = torch.full((8,), 6e18)
        assert torch.isfinite(losses.critic_loss(torch.zeros(2, 8), target))
    learner.update(batch)
    after = tensors(learner)
    assert all(torch.equal(before[name], after[name]) for name in before if name != "noise_state")
    assert (learner.updates, learner.metrics()["learner_nonfinite_total"]) == (0, 1)


def test_learner_stops_loudly_when_nothing_is_finite_any_more() -> None:
    learner = build()
    bad = batch_of(reward=np.full(8, np.inf, np.float32))
    for _ in range(MAX_SKIPPED - 1):
        learner.update(bad)
    learner.update(batch_of())
    for _ in range(MAX_SKIPPED - 1):
        learner.update(bad)
    with pytest.raises(TrainingDivergedError, match=r"10 times in a row at update 1;.*critic_norm"):
        learner.update(bad)


def test_annealed_temperature_falls_geometrically_to_its_end_and_stays() -> None:
    options: dict[str, Any] = {
        "temperature_mode": "annealed",
        "temperature": 0.4,
        "final_temperature": 0.1,
        "annealing_updates": 4,
    }
    learner = build(**options)
    seen = []
    for update in range(6):
        learner.update(batch_of(seed=update))
        seen.append(float(learner.log_temperature.detach().exp()))
    assert seen == pytest.approx([0.4 / 4**0.25, 0.2, 0.4 / 4**0.75, 0.1, 0.1, 0.1], rel=1e-5)
    saved = learner.save()
    resumed = build(**options | {"annealing_updates": 12})
    resumed.load(saved)
    assert float(resumed.log_temperature.detach().exp()) == pytest.approx(0.2, rel=1e-5)


@pytest.mark.parametrize("encoder", [STATE_ONLY, replace(SEEING, goal=True)], ids=["state", "slots"])
def test_saved_learner_continues_bit_for_bit(encoder: EncoderConfig) -> None:
    options: dict[str, Any] = {"temperature_mode": "auto", "critic_norm": "layer"}
    straight = build(encoder, **options)
    for update in range(4):
        straight.update(batch_of(encoder, seed=update))
    saved = straight.save()
    resumed = build(encoder, seed=99, **options)
    resumed.load(saved)
    for update in range(4, 4 + METRICS_EVERY):
        straight.update(batch_of(encoder, seed=update))
        resumed.update(batch_of(encoder, seed=update))
    assert straight.metrics() == resumed.metrics()
    assert straight.updates == resumed.updates == 4 + METRICS_EVERY
    expected, found = tensors(straight), tensors(resumed)
    assert expected.keys() == found.keys()
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    assert not torch.equal(expected["actor.network.weights.0"], saved["tensors"]["actor.network.weights.0"])


def test_end_to_end_learner_continues_with_moments_that_lie_in_memory_as_their_weights_do() -> None:
    config = replace(SEEING, backbone="random")
    rng = np.random.default_rng(0)
    pictures = rng.integers(0, 256, (4, 2, 128, 128, 3), dtype=np.uint8)
    batches = [batch_of(config, size=2, seed=i, visual=pictures[i], next_visual=pictures[i + 1]) for i in range(3)]
    straight = build(config, end_to_end=True)
    for batch in batches[:2]:
        straight.update(batch)
    resumed = build(config, seed=99, end_to_end=True)
    resumed.load(straight.save())
    for learner in (straight, resumed):
        learner.update(batches[2])
    expected, found = tensors(straight), tensors(resumed)
    assert not [name for name in expected if not torch.equal(expected[name], found[name])]


@pytest.mark.parametrize(
    "name", ["actor.network.weights.0", "critic_optimiser.0.exp_avg", "log_temperature", "noise_state"]
)
def test_state_that_lacks_a_tensor_is_refused_by_name(name: str) -> None:
    learner = build()
    learner.update(batch_of())
    saved = learner.save()
    del saved["tensors"][name]
    with pytest.raises(ValueError, match=f"checkpoint: .*{name}.*missing"):
        build().load(saved)


def test_state_of_another_agent_is_refused_by_name() -> None:
    saved = build().save()
    with pytest.raises(ValueError, match=r"checkpoint: .*encoder\..* is missing"):
        build(SEEING).load(saved)
    with pytest.raises(ValueError, match=r"checkpoint: .* has shape .*this agent needs"):
        build(hidden=(8,)).load(saved)
    saved["tensors"]["actor.extra"] = torch.zeros(1)
    with pytest.raises(ValueError, match=r"checkpoint: actor\.extra is not part of this agent"):
        build().load(saved)


def test_same_seed_gives_the_same_losses_and_another_seed_others() -> None:
    runs = []
    for seed in (0, 0, 1):
        learner = build(seed=seed)
        for update in range(METRICS_EVERY):
            learner.update(batch_of(seed=update))
        runs.append(learner.metrics())
    assert runs[0] == runs[1]
    assert runs[0]["learner_critic_loss"] != runs[2]["learner_critic_loss"]


def test_acting_arrays_are_copies_of_what_acting_needs() -> None:
    learner = build(SEEING)
    arrays = learner.acting_arrays()
    assert all(name.startswith(("actor.", "encoder.")) for name in arrays)
    assert not [name for name in arrays if "backbone" in name]
    kept = arrays["actor.network.weights.0"].copy()
    learner.update(batch_of(SEEING))
    assert np.array_equal(arrays["actor.network.weights.0"], kept)
    assert not np.array_equal(learner.acting_arrays()["actor.network.weights.0"], kept)
