"""Actor, critics and value network: the squashed Gaussian's density by quadrature, and the ensembles' independence."""

import math

import numpy as np
import pytest
import torch

from slotfilm_dist.nets.policy_heads import Actor, EnsembleMLP, TwinCritic, ValueNet, squashed_log_prob


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def constant_actor(mean: list[float], log_std: list[float]) -> Actor:
    """An actor that says the same everywhere."""
    actor = Actor(3, len(mean), (4,), log_std_range=(-20.0, 20.0), generator=generator())
    with torch.no_grad():
        actor.network.weights[-1].zero_()
        actor.network.biases[-1].copy_(torch.tensor(mean + log_std))
    return actor


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, 0.0), (0.7, -1.0), (-1.5, 0.5), (0.3, -3.0)])
def test_density_of_the_squashed_action_integrates_to_one(mean: float, log_std: float) -> None:
    std = math.exp(log_std)
    actions = torch.linspace(-1 + 1e-7, 1 - 1e-7, 400_001, dtype=torch.float64)
    unsquashed = torch.atanh(actions)
    noise = (unsquashed - mean) / std
    log_prob = squashed_log_prob(unsquashed[:, None], noise[:, None], torch.full_like(noise, log_std)[:, None])
    assert float(torch.trapezoid(log_prob.exp(), actions)) == pytest.approx(1.0, abs=2e-3)


def test_log_prob_agrees_with_torchs_own_transformed_distribution() -> None:
    actor = constant_actor([0.4, -0.9], [-0.5, 0.2])
    noise = torch.randn(50, 2, generator=generator(1))
    sample = actor(torch.zeros(50, 3), noise)
    normal = torch.distributions.Normal(torch.tensor([0.4, -0.9]), torch.tensor([-0.5, 0.2]).exp())
    expected = torch.distributions.TransformedDistribution(
        normal, torch.distributions.TanhTransform(cache_size=1)
    ).log_prob(sample.action)
    assert torch.allclose(sample.log_prob, expected.sum(-1), atol=1e-3)


def test_actions_are_summed_over_once() -> None:
    one = constant_actor([0.4], [-0.5])(torch.zeros(1, 3), torch.tensor([[0.3]])).log_prob
    three = constant_actor([0.4] * 3, [-0.5] * 3)(torch.zeros(1, 3), torch.full((1, 3), 0.3)).log_prob
    assert three.item() == pytest.approx(3 * one.item(), rel=1e-6)


@pytest.mark.parametrize("mean", [-1e3, -30.0, 30.0, 1e3])
def test_extreme_values_give_finite_log_prob_and_gradient(mean: float) -> None:
    actor = constant_actor([mean], [-5.0])
    sample = actor(torch.zeros(4, 3), torch.randn(4, 1, generator=generator()))
    sample.log_prob.sum().backward()
    assert torch.isfinite(sample.log_prob).all()
    assert sample.action.abs().max() <= 1
    assert all(torch.isfinite(p.grad).all() for p in actor.parameters() if p.grad is not None)
    # log(1 - tanh(u)^2) tends to 2 log 2 - 2 |u|, where the naive form has long become log 0.
    noise = torch.zeros(1, 1)
    tail = squashed_log_prob(torch.tensor([[mean]]), noise, noise) + 0.5 * math.log(2 * math.pi)
    assert float(tail) == pytest.approx(2 * abs(mean) - 2 * math.log(2), rel=1e-5)


def test_log_std_is_clamped() -> None:
    actor = Actor(3, 2, (4,), log_std_range=(-5.0, 2.0), generator=generator())
    with torch.no_grad():
        actor.network.biases[-1].copy_(torch.tensor([0.0, 0.0, -100.0, 100.0]))
    assert actor.distribution(torch.zeros(1, 3))[1].tolist() == [[-5.0, 2.0]]


def test_mode_is_tanh_of_the_mean() -> None:
    actor = Actor(3, 2, (4,), generator=generator())
    latent = torch.randn(5, 3, generator=generator(1))
    assert torch.equal(actor.mode(latent), torch.tanh(actor.distribution(latent)[0]))
    assert torch.allclose(actor.mode(latent), actor(latent, torch.zeros(5, 2)).action)


def test_ensemble_equals_separate_networks_of_linear_layers() -> None:
    ensemble = EnsembleMLP(2, (3, 5, 4, 1), layer_norm=True, generator=generator())
    with torch.no_grad():
        for parameter in (*ensemble.scales, *ensemble.shifts):
            parameter.uniform_(0.5, 1.5, generator=generator(2))
    x = torch.randn(6, 3, generator=generator(1))
    found = ensemble(x)
    for member in range(2):
        hidden = x
        for i in range(3):
            hidden = hidden @ ensemble.weights[i][member] + ensemble.biases[i][member]
            if i < 2:
                norm = torch.nn.functional.layer_norm(hidden, hidden.shape[-1:])
                hidden = torch.relu(norm * ensemble.scales[i][member] + ensemble.shifts[i][member])
        assert torch.allclose(found[member], hidden, atol=1e-6)
    assert not torch.allclose(found[0], found[1])


def test_frozen_critic_passes_gradient_to_its_input_only() -> None:
    critic = TwinCritic(3, 2, (4,), layer_norm=True, generator=generator())
    latent, action = (torch.randn(5, size, generator=generator(size)).requires_grad_() for size in (3, 2))
    frozen = critic(latent, action, frozen=True)
    assert torch.equal(frozen, critic(latent, action))
    frozen.sum().backward()
    assert all(p.grad is None for p in critic.parameters())
    assert action.grad is not None
    assert action.grad.abs().sum() > 0


def test_initial_weights_follow_from_the_generator_and_not_from_global_state() -> None:
    torch.manual_seed(1)
    first = ValueNet(3, (4,), generator=generator(7)).state_dict()
    torch.manual_seed(2)
    before = torch.get_rng_state()
    second = ValueNet(3, (4,), generator=generator(7)).state_dict()
    other = ValueNet(3, (4,), generator=generator(8)).state_dict()
    assert torch.equal(before, torch.get_rng_state())
    assert all(torch.equal(first[k], second[k]) for k in first)
    assert not all(torch.equal(first[k], other[k]) for k in first)


def test_papers_actor_has_80398_parameters() -> None:
    count = sum(p.numel() for p in Actor(42, 7, (256, 256)).parameters())
    assert count == 80_398
    weights = Actor(42, 7, (256, 256), generator=generator()).network.weights
    assert np.isclose(float(weights[0].detach().abs().max()), 1 / math.sqrt(42), rtol=1e-3)
