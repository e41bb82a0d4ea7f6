"""Soft Actor-Critic on a fusion encoder: one `update` is one line of Algorithm 1's loop."""

import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from slotfilm_dist.config import RunConfig
from slotfilm_dist.learning import losses
from slotfilm_dist.learning.checkpoint import plain_tensors
from slotfilm_dist.messages import SampleBatch
from slotfilm_dist.nets.interface import Encoder
from slotfilm_dist.nets.policy_heads import Actor, TwinCritic, ValueNet

METRICS_EVERY = 10
"""Updates between measurements of the metrics; reading them every time would cost a tenth of an update."""
MAX_SKIPPED = 10
"""Non-finite updates in a row after which the learner stops."""


class TrainingDivergedError(RuntimeError):
    """Losses were not finite for `MAX_SKIPPED` updates in a row."""


class SacLearner:
    """Holds encoder, actor, critics and value network and improves them batch by batch.

    Args:
        config: the run; `sac`, `lr` and `encoder` matter here.
        encoder: turns observations into latents; trained by the critics' gradient only.
        action_dim: size of the action.
        seed: root of the initial weights and of the action noise.
        device: where to compute.
    """

    def __init__(
        self, config: RunConfig, encoder: Encoder, action_dim: int, seed: np.random.SeedSequence, device: torch.device
    ) -> None:
        self.config = config
        self.device = device
        init_seed, noise_seed = (int(s.generate_state(1)[0]) for s in seed.spawn(2))
        generator = torch.Generator().manual_seed(init_seed)
        self._noise = torch.Generator(device=device).manual_seed(noise_seed)
        sac = config.sac
        norm = sac.critic_norm == "layer"
        latent = encoder.latent_dim
        self.encoder = encoder.to(device)
        self.actor = Actor(
            latent, action_dim, sac.hidden, log_std_range=(sac.log_std_min, sac.log_std_max), generator=generator
        ).to(device)
        self.critic = TwinCritic(latent, action_dim, sac.hidden, layer_norm=norm, generator=generator).to(device)
        self.value = ValueNet(latent, sac.hidden, layer_norm=norm, generator=generator).to(device)
        self.target_value = ValueNet(latent, sac.hidden, layer_norm=norm).to(device)
        self.target_value.load_state_dict(self.value.state_dict())
        self.target_value.requires_grad_(False)
        self.log_temperature = torch.tensor(math.log(sac.temperature), device=device, requires_grad=True)
        self._build_optimisers()
        self.updates = 0
        self.skipped_updates = 0
        self._skipped_in_a_row = 0
        self._metrics: dict[str, Tensor] = {}

    def _build_optimisers(self) -> None:
        lr = self.config.lr
        groups: list[dict[str, Any]] = [{"params": list(self.critic.parameters()), "lr": lr.critic_value}]
        groups.append({"params": self.encoder.fusion_parameters(), "lr": lr.fusion})
        groups.append({"params": self.encoder.gate_parameters(), "lr": lr.goal_gate})
        if self.config.sac.end_to_end:
            groups.append({"params": self.encoder.backbone_parameters(), "lr": lr.backbone})
        self._critic_optimiser = torch.optim.Adam([g for g in groups if g["params"]], fused=True)
        self._policy_optimiser = torch.optim.Adam(
            [
                {"params": list(self.value.parameters()), "lr": lr.critic_value},
                {"params": list(self.actor.parameters()), "lr": lr.actor},
            ],
            fused=True,
        )
        self._temperature_optimiser = torch.optim.Adam([self.log_temperature], lr=lr.temperature)
        self._targets = [p.data for p in self.target_value.parameters()]
        self._online = [p.data for p in self.value.parameters()]

    def update(self, batch: SampleBatch) -> None:
        """One gradient step of critics and encoder, value network, actor and target (Algorithm 1, lines 3-11).

        Raises:
            TrainingDivergedError: the loss was not finite `MAX_SKIPPED` times in a row.
        """
        sac = self.config.sac
        action, terminated, truncated = (self._tensor(x) for x in (batch.action, batch.terminated, batch.truncated))
        reward = self._tensor(batch.reward) * sac.reward_scale
        latent = self._encode(batch.visual, batch.proprio, batch.goal)
        with torch.no_grad():
            next_latent = self._encode(batch.next_visual, batch.next_proprio, batch.next_goal)
            mask = losses.bootstrap_mask(terminated, truncated, sac.bootstrap)
            target = losses.critic_target(reward, mask, self.target_value(next_latent), sac.gamma)
        q = self.critic(latent, action)
        critic_loss = losses.critic_loss(q, target)
        if not self._step_critic(critic_loss):
            return

        seen = latent.detach()
        noise = torch.randn(action.shape, generator=self._noise, device=self.device)
        sample = self.actor(seen, noise)
        temperature = self.log_temperature.detach().exp()
        min_q = self.critic(seen, sample.action, frozen=True).amin(dim=0)
        value = self.value(seen)
        value_loss = losses.value_loss(value, min_q.detach(), sample.log_prob.detach(), temperature)
        actor_loss = losses.actor_loss(min_q, sample.log_prob, temperature)
        self._policy_optimiser.zero_grad(set_to_none=True)
        (value_loss + actor_loss).backward()
        self._policy_optimiser.step()
        if sac.temperature_mode == "auto":
            self._step_temperature(sample.log_prob.detach())
        losses.polyak(self._targets, self._online, sac.tau)
        self.updates += 1
        if self.updates % METRICS_EVERY == 0:
            self._measure(critic_loss, value_loss, actor_loss, q, target, sample.log_prob, temperature)

    def _step_critic(self, loss: Float[Tensor, ""]) -> bool:
        """Whether the loss was finite and the step taken."""
        if not torch.isfinite(loss):
            self.skipped_updates += 1
            self._skipped_in_a_row += 1
            if self._skipped_in_a_row >= MAX_SKIPPED:
                raise TrainingDivergedError(
                    f"the critic's loss was not finite {MAX_SKIPPED} times in a row at update {self.updates}; "
                    "lower lr.critic_value or lr.fusion, set sac.critic_norm = layer, or go back to a checkpoint"
                )
            return False
        self._skipped_in_a_row = 0
        self._critic_optimiser.zero_grad(set_to_none=True)
        loss.backward()
        clip = self.config.sac.grad_clip
        if clip:
            parameters = [p for group in self._critic_optimiser.param_groups for p in group["params"]]
            torch.nn.utils.clip_grad_norm_(parameters, clip)
        self._critic_optimiser.step()
        return True

    def _step_temperature(self, log_prob: Float[Tensor, " batch"]) -> None:
        self._temperature_optimiser.zero_grad(set_to_none=True)
        losses.temperature_loss(self.log_temperature, log_prob, self.config.sac.target_entropy).backward()
        self._temperature_optimiser.step()

    def _measure(
        self,
        critic_loss: Float[Tensor, ""],
        value_loss: Float[Tensor, ""],
        actor_loss: Float[Tensor, ""],
        q: Float[Tensor, "2 batch"],
        target: Float[Tensor, " batch"],
        log_prob: Float[Tensor, " batch"],
        temperature: Float[Tensor, ""],
    ) -> None:
        norms = {
            "learner_critic_gradient_norm": self.critic.parameters(),
            "learner_encoder_gradient_norm": self.encoder.fusion_parameters(),
            "learner_actor_gradient_norm": self.actor.parameters(),
        }
        self._metrics = {
            "learner_critic_loss": critic_loss.detach(),
            "learner_value_loss": value_loss.detach(),
            "learner_actor_loss": actor_loss.detach(),
            "learner_q_mean": q.detach().mean(),
            "learner_target_mean": target.mean(),
            "learner_entropy_nats": -log_prob.detach().mean(),
            "learner_temperature": temperature,
        } | {name: _gradient_norm(list(parameters)) for name, parameters in norms.items()}

    def metrics(self) -> dict[str, float]:
        """The latest measurements, by the metric catalogue's names."""
        values = {name: float(value) for name, value in self._metrics.items()}
        return values | {"learner_updates_total": self.updates, "learner_nonfinite_total": self.skipped_updates}

    def acting_arrays(self) -> dict[str, np.ndarray]:
        """What a worker needs to act: actor and the encoder's parts that RL changes."""
        actor = {f"actor.{k}": v.detach().cpu().numpy().copy() for k, v in self.actor.state_dict().items()}
        return actor | {f"encoder.{k}": v for k, v in self.encoder.acting_state().items()}

    def _encode(self, visual: np.ndarray, proprio: np.ndarray, goal: np.ndarray) -> Float[Tensor, "batch latent"]:
        return self.encoder(self._tensor(visual), self._tensor(proprio), self._tensor(goal))

    def _tensor(self, array: np.ndarray) -> Tensor:
        with warnings.catch_warnings():
            # Arrays from shared memory are read-only, and nothing here writes to them.
            warnings.filterwarnings("ignore", message=".*not writable.*")
            return torch.from_numpy(array).to(self.device, non_blocking=True)

    def modules(self) -> dict[str, torch.nn.Module]:
        """Every network by name, for checkpoints."""
        return {
            "encoder": self.encoder,
            "actor": self.actor,
            "critic": self.critic,
            "value": self.value,
            "target_value": self.target_value,
        }

    def _optimisers(self) -> dict[str, torch.optim.Optimizer]:
        return {
            "critic_optimiser": self._critic_optimiser,
            "policy_optimiser": self._policy_optimiser,
            "temperature_optimiser": self._temperature_optimiser,
        }

    def save(self) -> dict[str, Any]:
        """Everything that the next update depends on, as flat tensors by name and plain counters."""
        tensors = {f"{n}.{k}": v for n, m in self.modules().items() for k, v in m.state_dict().items()}
        for name, optimiser in self._optimisers().items():
            for index, state in optimiser.state_dict()["state"].items():
                tensors |= {f"{name}.{index}.{key}": value for key, value in state.items()}
        tensors["log_temperature"] = self.log_temperature
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
        for name in ("log_temperature", "noise_state"):
            if name not in tensors:
                raise ValueError(f"checkpoint: {name} is missing")
        with torch.no_grad():
            self.log_temperature.copy_(tensors["log_temperature"])
        self._noise.set_state(tensors["noise_state"])
        self.updates = int(state["updates"])
        self.skipped_updates = int(state["skipped_updates"])


def _gradient_norm(parameters: list[torch.nn.Parameter]) -> Float[Tensor, ""]:
    gradients = [p.grad for p in parameters if p.grad is not None]
    if not gradients:
        return torch.zeros(())
    return torch.linalg.vector_norm(torch.stack(torch._foreach_norm(gradients)))


def _load_module(module: torch.nn.Module, name: str, tensors: Mapping[str, Tensor]) -> None:
    prefix = name + "."
    saved = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
    expected = module.state_dict()
    for key in expected.keys() | saved.keys():
        if key not in saved or key not in expected:
            raise ValueError(
                f"checkpoint: {prefix}{key} is {'missing' if key not in saved else 'not part of this agent'}"
            )
        if saved[key].shape != expected[key].shape:
            raise ValueError(
                f"checkpoint: {prefix}{key} has shape {tuple(saved[key].shape)}, "
                f"this agent needs {tuple(expected[key].shape)}"
            )
    module.load_state_dict(saved)


def _load_optimiser(optimiser: torch.optim.Optimizer, name: str, tensors: Mapping[str, Tensor]) -> None:
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        owner, _, rest = key.partition(".")
        if owner == name:
            index, _, field = rest.partition(".")
            state.setdefault(int(index), {})[field] = value
    fields = {field for moments in state.values() for field in moments}
    for index, moments in state.items():
        if lacking := sorted(fields - moments.keys()):
            raise ValueError(f"checkpoint: {name}.{index}.{lacking[0]} is missing")
    current = optimiser.state_dict()
    optimiser.load_state_dict({"state": state, "param_groups": current["param_groups"]})
