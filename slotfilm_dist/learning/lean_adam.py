"""Adam with torch's fused kernel and next to nothing around it."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

PIECE = 8192
"""Elements of a piece, see `pieces`."""


def pieces(tensors: Iterable[Tensor]) -> list[Tensor]:
    """The same numbers, flat and cut up, for the kernels that take many tensors at once.

    On a GPU they give 65,536 elements of a tensor to one block of threads, so that a whole layer waits for one. Tensors
    that are not contiguous stay whole.
    """
    cut: list[Tensor] = []
    for tensor in tensors:
        cut += tensor.detach().view(-1).split(PIECE) if tensor.is_contiguous() else [tensor.detach()]
    return cut


class LeanAdam(torch.optim.Adam):
    """`torch.optim.Adam(fused=True)`, the same to the last bit and cheaper for networks as small as these.

    Torch gathers its lists anew in every step and counts the steps of every parameter in a tensor of its own. Here the
    lists are kept and the parameters of a group share one count. State and checkpoints are torch's.
    """

    found_inf: Tensor | None
    """1 where the next step is to change nothing, else 0; None never asks. A name that torch's own step looks for."""

    def __init__(self, groups: list[dict[str, Any]]) -> None:
        super().__init__(groups, fused=True)
        self.found_inf = None
        self._lists: list[tuple[list[Tensor], ...]] | None = None

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> None:  # type: ignore[override]  # no closure is used
        """One step; as torch's own while a parameter has no gradient, which torch leaves out then."""
        assert closure is None, "gradients are there already"
        gradients = [[p.grad for p in group["params"]] for group in self.param_groups]
        if any(g is None for of_group in gradients for g in of_group) or not self._gather():
            self._count_apart()
            super().step()
            return
        assert self._lists is not None
        if gradients[0][0].is_cuda:
            gradients = [
                pieces(g.contiguous() if p.is_contiguous() else g for p, g in zip(of["params"], grads, strict=True))
                for of, grads in zip(self.param_groups, gradients, strict=True)
            ]
        for group, grads, (parameters, first, second, steps) in zip(
            self.param_groups, gradients, self._lists, strict=True
        ):
            steps[0] += 1 if self.found_inf is None else 1 - self.found_inf
            torch._fused_adam_(  # type: ignore[reportPrivateImportUsage]  # what torch's own fused Adam calls
                parameters,
                grads,
                first,
                second,
                [],
                steps,
                lr=group["lr"],
                beta1=group["betas"][0],
                beta2=group["betas"][1],
                weight_decay=group["weight_decay"],
                eps=group["eps"],
                amsgrad=False,
                maximize=False,
                found_inf=self.found_inf,
            )

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Forget the gradients."""
        assert set_to_none, "gradients are never accumulated"
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None

    def state_dict(self) -> dict[str, Any]:
        """The state in torch's own form, every count a tensor of its own."""
        state = super().state_dict()
        of_parameters = {i: {**moments, "step": moments["step"].clone()} for i, moments in state["state"].items()}
        return {**state, "state": of_parameters}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:  # type: ignore[override]  # torch's own alias
        """Continue from torch's own form of the state."""
        super().load_state_dict(dict(state_dict))
        self._lists = None

    def _count_apart(self) -> None:
        """Give every parameter a count of its own again, as torch wants it."""
        self._lists = None
        for state in self.state.values():
            state["step"] = state["step"].clone()

    def _gather(self) -> bool:
        """Whether the lists could be made: every parameter has a state, and those of a group count alike."""
        if self._lists is not None:
            return True
        lists: list[tuple[list[Tensor], ...]] = []
        for group in self.param_groups:
            states = [self.state[p] for p in group["params"] if p in self.state]
            if len(states) < len(group["params"]) or len({float(s["step"]) for s in states}) != 1:
                return False
            count = states[0]["step"]
            for state in states:
                state["step"] = count
            columns = [list(group["params"]), *([s[key] for s in states] for key in ("exp_avg", "exp_avg_sq"))]
            if count.is_cuda:
                columns = [pieces(column) for column in columns]
            lists.append((*columns, [count] * len(columns[0])))
        self._lists = lists
        return True
