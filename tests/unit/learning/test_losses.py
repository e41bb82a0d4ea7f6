"""Equations 5 to 9 against cases computed by hand."""

import pytest
import torch

from slotfilm_dist.learning import losses


@pytest.mark.parametrize(
    ("mode", "expected"),
    [("on_truncation", [1, 0, 1, 0]), ("always", [1, 1, 1, 1]), ("never", [1, 0, 0, 0])],
)
def test_bootstrap_mask_of_running_terminated_truncated_and_both(mode: str, expected: list[float]) -> None:
    terminated = torch.tensor([False, True, False, True])
    truncated = torch.tensor([False, False, True, True])
    assert losses.bootstrap_mask(terminated, truncated, mode).tolist() == expected


def test_critic_target_is_reward_plus_discounted_masked_value() -> None:
    target = losses.critic_target(torch.tensor([1.0, 2.0]), torch.tensor([1.0, 0.0]), torch.tensor([10.0, 10.0]), 0.9)
    assert target.tolist() == [10.0, 2.0]


def test_critic_loss_is_half_the_mean_squared_error_of_each_critic_added() -> None:
    q = torch.tensor([[1.0, 3.0], [0.0, 0.0]])
    assert float(losses.critic_loss(q, torch.tensor([2.0, 1.0]))) == pytest.approx(
        0.5 * (1 + 4) / 2 + 0.5 * (4 + 1) / 2
    )


def test_value_loss_subtracts_temperature_times_log_prob() -> None:
    loss = losses.value_loss(
        torch.tensor([1.0, 0.0]), torch.tensor([2.0, 3.0]), torch.tensor([-1.0, 2.0]), torch.tensor(0.5)
    )
    assert float(loss) == pytest.approx(0.5 * ((1 - 2.5) ** 2 + (0 - 2.0) ** 2) / 2)


def test_actor_loss_trades_value_against_entropy() -> None:
    loss = losses.actor_loss(torch.tensor([2.0, 4.0]), torch.tensor([-1.0, 3.0]), torch.tensor(0.5))
    assert float(loss) == pytest.approx(((-0.5 - 2) + (1.5 - 4)) / 2)


@pytest.mark.parametrize(("entropy", "rises"), [(-9.0, True), (-5.0, False)])
def test_temperature_rises_while_the_policy_is_less_random_than_wanted(entropy: float, rises: bool) -> None:
    log_temperature = torch.zeros((), requires_grad=True)
    losses.temperature_loss(log_temperature, torch.tensor([-entropy]), -7.0).backward()
    assert log_temperature.grad is not None
    assert (float(log_temperature.grad) < 0) == rises
    assert abs(float(log_temperature.grad)) == pytest.approx(2.0)


def test_polyak_moves_the_target_by_tau_in_place() -> None:
    target, online = [torch.tensor([0.0, 1.0])], [torch.tensor([10.0, 1.0])]
    losses.polyak(target, online, 0.1)
    assert target[0].tolist() == [1.0, 1.0]
    assert online[0].tolist() == [10.0, 1.0]


def test_scaling_reward_and_temperature_scales_the_losses() -> None:
    """Scale 10 with temperature 1 is scale 1 with temperature 0.1: values, losses and targets differ by the factor."""
    generator = torch.Generator().manual_seed(0)
    reward, value, min_q, log_prob = torch.randn(4, 8, generator=generator)
    mask = torch.ones(8)
    small, large = torch.tensor(0.1), torch.tensor(1.0)
    target = losses.critic_target(reward, mask, value, 0.99)
    assert torch.allclose(losses.critic_target(10 * reward, mask, 10 * value, 0.99), 10 * target)
    assert torch.allclose(
        losses.value_loss(10 * value, 10 * min_q, log_prob, large),
        100 * losses.value_loss(value, min_q, log_prob, small),
    )
    assert torch.allclose(
        losses.actor_loss(10 * min_q, log_prob, large), 10 * losses.actor_loss(min_q, log_prob, small)
    )
