"""The optimiser with torch's kernel and less around it, against torch's own."""

import copy

import pytest
import torch
from torch import nn

from slotfilm_dist.learning.lean_adam import LeanAdam

SHAPES = ((2, 5, 7), (2, 1, 7), (3,))


def parameters() -> list[nn.Parameter]:
    generator = torch.Generator().manual_seed(0)
    return [nn.Parameter(torch.randn(shape, generator=generator)) for shape in SHAPES]


def pair() -> tuple[list[nn.Parameter], LeanAdam, list[nn.Parameter], torch.optim.Adam]:
    ours, theirs = parameters(), parameters()

    def groups(of: list[nn.Parameter]) -> list[dict]:
        return [{"params": of[:2], "lr": 1e-2}, {"params": of[2:], "lr": 1e-3}]

    return ours, LeanAdam(groups(ours)), theirs, torch.optim.Adam(groups(theirs), fused=True)


def step(i: int, ours: list[nn.Parameter], lean: LeanAdam, theirs: list[nn.Parameter], adam: torch.optim.Adam) -> None:
    generator = torch.Generator().manual_seed(i)
    for mine, other in zip(ours, theirs, strict=True):
        mine.grad = torch.randn(mine.shape, generator=generator)
        other.grad = mine.grad.clone()
    lean.step()
    adam.step()


def same(ours: list[nn.Parameter], theirs: list[nn.Parameter]) -> bool:
    return all(torch.equal(mine, other) for mine, other in zip(ours, theirs, strict=True))


def test_steps_equal_torchs_bit_for_bit_with_rates_changed_on_the_way() -> None:
    both = ours, lean, theirs, adam = pair()
    for i in range(10):
        if i == 5:
            lean.param_groups[0]["lr"] = adam.param_groups[0]["lr"] = 1e-4
        step(i, *both)
        assert same(ours, theirs)


def test_parameter_without_a_gradient_is_left_out_as_torch_does() -> None:
    both = ours, lean, theirs, adam = pair()
    for i in range(3):
        step(i, *both)
    for of in (ours, theirs):
        of[0].grad = None
    lean.step()
    adam.step()
    for i in range(3, 6):
        step(i, *both)
        assert same(ours, theirs)


@pytest.mark.parametrize("writer", ["ours", "torch"])
def test_state_goes_to_and_from_torchs_own(writer: str) -> None:
    both = ours, lean, theirs, adam = pair()
    for i in range(3):
        step(i, *both)
    state = copy.deepcopy((lean if writer == "ours" else adam).state_dict())
    lean.load_state_dict(copy.deepcopy(state))
    adam.load_state_dict(copy.deepcopy(state))
    assert {float(s["step"]) for s in state["state"].values()} == {3.0}
    for i in range(3, 6):
        step(i, *both)
        assert same(ours, theirs)


def test_zero_grad_forgets_the_gradients() -> None:
    ours, lean, theirs, adam = pair()
    step(0, ours, lean, theirs, adam)
    lean.zero_grad()
    assert all(p.grad is None for p in ours)
