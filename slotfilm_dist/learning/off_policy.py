"""What the off-policy learners share: saving and loading, metrics, and a halt when losses stop being finite."""

import abc
import hashlib
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from slotfilm_dist.learning.checkpoint import plain_tensors
from slotfilm_dist.messages import SampleBatch
from slotfilm_dist.nets.agent import AgentEncoder
from slotfilm_dist.nets.deterministic_heads import DeterministicActor
from slotfilm_dist.nets.policy_heads import Actor

METRICS_EVERY = 10
"""Updates between measurements of the metrics; reading them every time would cost a tenth of an update."""
NOISE_STATE_BYTES = (torch.Generator().get_state().numel(), 16)
"""Sizes of a random stream's state on a CPU and on a GPU."""
MAX_SKIPPED = 10
"""Updates skipped in a row, for a loss or gradient that is not finite, after which training has diverged."""


ActorT = TypeVar("ActorT", Actor, DeterministicActor)


class TrainingDivergedError(RuntimeError):
    """Losses or gradients were not finite for `MAX_SKIPPED` updates in a row."""


class OffPolicyLearner(abc.ABC, Generic[ActorT]):
    """An encoder and networks on its latent that improve batch by batch.

    Args:
        encoder: turns observations into latents.
        noise_seed: of every random number of the updates.
        device: where to compute.
    """

    actor: ActorT

    def __init__(self, encoder: AgentEncoder, noise_seed: int, device: torch.device) -> None:
        self.encoder = encoder.to(device)
        self.device = device
        self.updates = 0
        self.skipped_updates = 0
        self._noise = torch.Generator(device=device).manual_seed(noise_seed)
        self._skipped_in_a_row = 0
        self._metrics: dict[str, Tensor] = {}

    @abc.abstractmethod
    def update(self, batch: SampleBatch) -> None:
        """One gradient step of every network.

        Raises:
            TrainingDivergedError: loss or gradient was not finite `MAX_SKIPPED` times in a row.
        """

    @abc.abstractmethod
    def modules(self) -> dict[str, torch.nn.Module]:
        """Every network by name, for checkpoints."""

    @abc.abstractmethod
    def _optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Every optimiser by name, for checkpoints."""

    def _loose_tensors(self) -> dict[str, Tensor]:
        """Learned tensors that belong to no network, for checkpoints."""
        return {}

    def settle(self) -> None:
        """Wait for updates under way, after which `updates` counts those that were made."""
        return  # there are none where every update looks at its own losses

    def metrics(self) -> dict[str, float]:
        """The latest measurements, by the metric catalogue's names."""
        values = {name: float(value) for name, value in self._metrics.items()}
        return values | {"learner_updates_total": self.updates, "learner_nonfinite_total": self.skipped_updates}

    def acting_arrays(self) -> dict[str, np.ndarray]:
        """What a worker needs to act: actor and the encoder's parts that RL changes."""
        actor = {f"actor.{k}": v.detach().cpu().numpy().copy() for k, v in self.actor.state_dict().items()}
        return actor | {f"encoder.{k}": v for k, v in self.encoder.acting_state().items()}

    def save(self) -> dict[str, Any]:
        """Everything that the next update depends on, as flat tensors by name and plain counters."""
        tensors = {f"{n}.{k}": v for n, m in self.modules().items() for k, v in m.state_dict().items()}
        for name, optimiser in self._optimisers().items():
            for index, state in optimiser.state_dict()["state"].items():
                tensors |= {f"{name}.{index}.{key}": value for key, value in state.items()}
        tensors |= self._loose_tensors()
        tensors["noise_state"] = self._noise.get_state()
        return {
            "tensors": plain_tensors(tensors),
            "updates": self.updates,
            "skipped_updates": self.skipped_updates,
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state.

        Raises:
            ValueError: a tensor is missing, unknown, or of another shape.
        """
        tensors: dict[str, Tensor] = dict(state["tensors"])
        for name, module in self.modules().items():
            _load_module(module, name, tensors)
        for name, optimiser in self._optimisers().items():
            _load_optimiser(optimiser, name, tensors)
        loose = self._loose_tensors()
        for name in (*loose, "noise_state"):
            if name not in tensors:
                raise ValueError(f"checkpoint: {name} is missing")
        for name, own in loose.items():
            _check_shape(name, tensors[name], own)
        for name in ("updates", "skipped_updates"):
            if type(state.get(name)) is not int or state[name] < 0:
                raise ValueError(f"checkpoint: {name} is {state.get(name)!r}, must be a whole number, 0 or more")
        with torch.no_grad():
            for name, own in loose.items():
                own.copy_(tensors[name])
        self._load_noise(tensors["noise_state"])
        self.updates = state["updates"]
        self.skipped_updates = state["skipped_updates"]

    def _load_noise(self, state: Tensor) -> None:
        """Continue the random stream; one of another device cannot be, so a new one is drawn from its state."""
        own = self._noise.get_state().numel()
        if state.numel() != own and state.numel() in NOISE_STATE_BYTES:
            digest = hashlib.sha256(state.numpy().tobytes()).digest()
            self._noise.manual_seed(int.from_bytes(digest[:8], "big") >> 1)
            return
        try:
            self._noise.set_state(state)
        except (RuntimeError, TypeError) as error:
            raise ValueError(f"checkpoint: noise_state is no state of a random stream ({error})") from None

    def scale_rates(self, factor: float) -> None:
        """Multiply every optimiser's rate."""
        for optimiser in self._optimisers().values():
            for group in optimiser.param_groups:
                group["lr"] *= factor

    def _descend(self, optimiser: torch.optim.Optimizer, loss: Float[Tensor, ""], clip: float, advice: str) -> bool:
        """Take a gradient step; False, with no parameter changed, where loss or gradient is not finite.

        Args:
            optimiser: of the parameters to change.
            loss: what to lower.
            clip: largest norm of the gradient; 0 leaves it as it is.
            advice: against losses that stay so.

        Raises:
            TrainingDivergedError: that happened `MAX_SKIPPED` times in a row.
        """
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        parameters = [p for group in optimiser.param_groups for p in group["params"]]
        norm = torch.nn.utils.clip_grad_norm_(parameters, clip) if clip else gradient_norm(parameters)
        if torch.isfinite(loss.detach() + norm):
            optimiser.step()
            return True
        self.skipped_updates += 1
        self._skipped_in_a_row += 1
        if self._skipped_in_a_row >= MAX_SKIPPED:
            self._skipped_in_a_row = 0
            raise TrainingDivergedError(
                f"loss or gradient was not finite {MAX_SKIPPED} times in a row at update {self.updates}; {advice}"
            )
        return False

    def _count_update(self) -> None:
        """Note that every network has taken its step."""
        self.updates += 1
        self._skipped_in_a_row = 0

    def _tensor(self, array: np.ndarray) -> Tensor:
        with warnings.catch_warnings():
            # Arrays from shared memory are read-only, and nothing here writes to them.
            warnings.filterwarnings("ignore", message=".*not writable.*")
            return torch.from_numpy(array).to(self.device, non_blocking=True)


def gradient_norm(
    parameters: Iterable[Tensor], cut: Callable[[list[Tensor]], list[Tensor]] = list
) -> Float[Tensor, ""]:
    """L2 norm of all gradients together; 0 where there is none.

    Args:
        parameters: whose gradients.
        cut: makes other tensors of the same numbers of them, for a GPU to work on side by side.
    """
    gradients = [p.grad for p in parameters if p.grad is not None]
    if not gradients:
        return torch.zeros(())
    norms = torch._foreach_norm(cut(gradients))  # pyright: ignore[reportPrivateImportUsage]
    return torch.linalg.vector_norm(torch.stack(norms))


def _load_module(module: torch.nn.Module, name: str, tensors: Mapping[str, Tensor]) -> None:
    prefix = name + "."
    saved = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
    expected = module.state_dict()
    for key in expected.keys() | saved.keys():
        if key not in saved or key not in expected:
            raise ValueError(
                f"checkpoint: {prefix}{key} is {'missing' if key not in saved else 'not part of this agent'}"
            )
        _check_shape(prefix + key, saved[key], expected[key])
    module.load_state_dict(saved)


def _check_shape(name: str, saved: Tensor, own: Tensor) -> None:
    if saved.shape != own.shape:
        raise ValueError(f"checkpoint: {name} has shape {tuple(saved.shape)}, this agent needs {tuple(own.shape)}")


def _load_optimiser(optimiser: torch.optim.Optimizer, name: str, tensors: Mapping[str, Tensor]) -> None:
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        owner, _, rest = key.partition(".")
        if owner == name:
            index, _, field = rest.partition(".")
            if not (index.isdecimal() and index.isascii() and len(index) < 9 and int(index) < len(parameters)):
                raise ValueError(f"checkpoint: {key} is not part of this agent")
            parameter = parameters[int(index)]
            _check_shape(key, value, value.new_empty(()) if field == "step" else parameter)
            if field != "step":  # saved as they are read, but a fused step walks weights and moments side by side
                value = torch.empty_like(parameter, dtype=value.dtype, device=value.device).copy_(value)
            state.setdefault(int(index), {})[field] = value
    fields = {field for moments in state.values() for field in moments}
    for index, moments in state.items():
        if lacking := sorted(fields - moments.keys()):
            raise ValueError(f"checkpoint: {name}.{index}.{lacking[0]} is missing")
    current = optimiser.state_dict()
    optimiser.load_state_dict({"state": state, "param_groups": current["param_groups"]})
