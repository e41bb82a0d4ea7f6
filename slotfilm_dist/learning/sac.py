"""Soft Actor-Critic on an encoder: one `update` is one line of Algorithm 1's loop.

With `sac.augment_views = 2` it is the study's DrQ-v1 (Kostrikov et al. 2020, Algorithm 1 with K = M = 2) on the paper's
SAC with a value network; "all SAC-based methods share identical SAC hyperparameters" (Section 5.1). Point by point,
read against the publication's released code:

published                                           here
target: soft value of the target critics, averaged  target value network, averaged over K shifts of s'; the value
over K shifts of s', an action drawn for each       network stands for the expectation over actions and entropy
critics' loss averaged over M shifts of s           the same
actor and temperature see one shift of s            the same; the value network's own loss sees that shift too
shifts by whole pixels up to 4, border repeated     the same
encoder trained by the critics only, at their rate  the same (the variant sets `lr.fusion` to `lr.critic_value`)

Departures:
- s' goes through the online encoder: the target critics' own, slowly following encoder has no counterpart, for the only
  target network of this SAC reads a latent.
- Actor, critics and value network share one latent, see `nets.pixel_encoder`.
- Table A1 and `sac` give all numbers, not the publication: batch 512, 1024 x 1024 layers, every rate 1e-3, temperature
  tuned from 0.1, Polyak rate 0.01, actor and targets every 2nd update, log standard deviation squashed to [-10, 2].
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from slotfilm_dist.config import RunConfig, SacConfig
from slotfilm_dist.learning import losses
from slotfilm_dist.learning.augment import random_shift
from slotfilm_dist.learning.lean_adam import LeanAdam
from slotfilm_dist.learning.off_policy import METRICS_EVERY, OffPolicyLearner, gradient_norm
from slotfilm_dist.messages import SampleBatch
from slotfilm_dist.nets.agent import AgentEncoder
from slotfilm_dist.nets.capture import Aside
from slotfilm_dist.nets.policy_heads import Actor, TwinCritic, ValueNet

BATCH_FIELDS = (
    "visual",
    "next_visual",
    "proprio",
    "next_proprio",
    "goal",
    "next_goal",
    "action",
    "reward",
    "terminated",
    "truncated",
)
"""What an update reads of a batch."""
ADVICE = "lower lr.critic_value or lr.fusion, set sac.critic_norm = layer"


class CriticTerms(NamedTuple):
    """Half of an update: the critics and the encoder."""

    loss: Float[Tensor, ""]
    latent: Float[Tensor, "seen latent"]
    q: Float[Tensor, "2 seen"]
    target: Float[Tensor, " batch"]


class PolicyTerms(NamedTuple):
    """The other half: value network and actor, whose losses share no parameter and are added."""

    loss: Float[Tensor, ""]
    value_loss: Float[Tensor, ""]
    actor_loss: Float[Tensor, ""]
    value: Float[Tensor, " batch"]
    log_prob: Float[Tensor, " batch"]
    temperature: Float[Tensor, ""]


class SacLearner(OffPolicyLearner[Actor]):
    """Holds encoder, actor, critics and value network and improves them batch by batch.

    Args:
        config: the run; `sac`, `lr` and `encoder` matter here.
        encoder: turns observations into latents; trained by the critics' gradient only.
        action_dim: size of the action.
        seed: root of the initial weights and of the action noise.
        device: where to compute.
    """

    def __init__(
        self,
        config: RunConfig,
        encoder: AgentEncoder,
        action_dim: int,
        seed: np.random.SeedSequence,
        device: torch.device,
    ) -> None:
        init_seed, noise_seed = (int(s.generate_state(1)[0]) for s in seed.spawn(2))
        super().__init__(encoder, noise_seed, device)
        self.config = config
        generator = torch.Generator().manual_seed(init_seed)
        sac = config.sac
        norm = sac.critic_norm == "layer"
        latent = encoder.latent_dim
        self.actor = Actor(
            latent, action_dim, sac.hidden, log_std_range=(sac.log_std_min, sac.log_std_max), generator=generator
        ).to(device)
        self.critic = TwinCritic(latent, action_dim, sac.hidden, layer_norm=norm, generator=generator).to(device)
        self.value = ValueNet(latent, sac.hidden, layer_norm=norm, generator=generator).to(device)
        self.target_value = ValueNet(latent, sac.hidden, layer_norm=norm).to(device)
        self.target_value.load_state_dict(self.value.state_dict())
        self.target_value.requires_grad_(False)
        self.log_temperature = torch.tensor(math.log(sac.temperature), device=device, requires_grad=True)
        self._aside = Aside(torch.device("cpu"))
        """Where the graphs of a GPU fork."""
        self._build_optimisers()

    def _build_optimisers(self) -> None:
        lr = self.config.lr
        groups: list[dict[str, Any]] = [{"params": list(self.critic.parameters()), "lr": lr.critic_value}]
        groups.append({"params": self.encoder.fusion_parameters(), "lr": lr.fusion})
        groups.append({"params": self.encoder.gate_parameters(), "lr": lr.goal_gate})
        if self.config.sac.end_to_end:
            groups.append({"params": self.encoder.backbone_parameters(), "lr": lr.backbone})
        self._critic_optimiser = LeanAdam([g for g in groups if g["params"]])
        self._policy_optimiser = LeanAdam(
            [
                {"params": list(self.value.parameters()), "lr": lr.critic_value},
                {"params": list(self.actor.parameters()), "lr": lr.actor},
            ]
        )
        self._temperature_optimiser = LeanAdam([{"params": [self.log_temperature], "lr": lr.temperature}])
        self._targets = [p.data for p in self.target_value.parameters()]
        self._online = [p.data for p in self.value.parameters()]

    def update(self, batch: SampleBatch) -> None:
        """One gradient step of critics and encoder, value network, actor and target (Algorithm 1, lines 3-11).

        Raises:
            TrainingDivergedError: loss or gradient was not finite `MAX_SKIPPED` times in a row.
        """
        sac = self.config.sac
        tensors = {name: self._tensor(getattr(batch, name)) for name in BATCH_FIELDS}
        critics = self._critic_terms(tensors)
        if not self._descend(self._critic_optimiser, critics.loss, sac.grad_clip, ADVICE):
            return
        noise = torch.randn(batch.action.shape, generator=self._noise, device=self.device)
        policy = self._policy_terms(critics.latent[: len(noise)].detach(), noise)
        if not self._descend(self._policy_optimiser, policy.loss, 0.0, ADVICE):
            return
        if sac.temperature_mode == "auto":
            self._step_temperature(policy.log_prob)
        elif sac.temperature_mode == "annealed":
            self._set_temperature(annealed_temperature(sac, self.updates + 1))
        losses.polyak(self._targets, self._online, sac.tau)
        self._count_update()
        if self.updates % METRICS_EVERY == 0:
            self._metrics = self._measure(tensors, critics, policy)

    def _critic_terms(self, batch: Mapping[str, Tensor]) -> CriticTerms:
        """What the critics and the encoder learn from."""
        sac = self.config.sac
        latent = self._encode(batch["visual"], batch["proprio"], batch["goal"])
        with self._aside:
            target = self._critic_target(batch)
        views = max(1, sac.augment_views)
        q = self.critic(latent, batch["action"].repeat(views, 1))
        self._aside.join()
        return CriticTerms(losses.critic_loss(q, target.repeat(views)), latent, q, target)

    @torch.no_grad()
    def _critic_target(self, batch: Mapping[str, Tensor]) -> Float[Tensor, " batch"]:
        sac = self.config.sac
        reward = batch["reward"] * sac.reward_scale
        next_latent = self._encode(batch["next_visual"], batch["next_proprio"], batch["next_goal"])
        mask = losses.bootstrap_mask(batch["terminated"], batch["truncated"], sac.bootstrap)
        next_value = self.target_value(next_latent).view(-1, len(reward)).mean(dim=0)
        return losses.critic_target(reward, mask, next_value, sac.gamma)

    def _policy_terms(self, seen: Float[Tensor, "batch latent"], noise: Float[Tensor, "batch action"]) -> PolicyTerms:
        """What the value network and the actor learn from."""
        with self._aside:
            value = self.value(seen)
        sample = self.actor(seen, noise)
        temperature = self.log_temperature.detach().exp()
        min_q = self.critic(seen, sample.action, frozen=True).amin(dim=0)
        self._aside.join()
        log_prob = sample.log_prob.detach()
        value_loss = losses.value_loss(value, min_q.detach(), log_prob, temperature)
        actor_loss = losses.actor_loss(min_q, sample.log_prob, temperature)
        return PolicyTerms(value_loss + actor_loss, value_loss, actor_loss, value, log_prob, temperature)

    def _measure(self, batch: Mapping[str, Tensor], critics: CriticTerms, policy: PolicyTerms) -> dict[str, Tensor]:
        """The metrics of an update."""
        tuned = {}
        if self.config.sac.temperature_mode == "auto":
            tuned["learner_temperature_loss"] = self._temperature_loss(policy.log_prob).detach()
        return {
            **tuned,
            **self._gradient_norms(),
            **self.encoder.diagnostics(batch["proprio"]),
            "learner_critic_loss": critics.loss.detach(),
            "learner_value_loss": policy.value_loss.detach(),
            "learner_actor_loss": policy.actor_loss.detach(),
            "learner_q_mean": critics.q.detach().mean(),
            "learner_q_max": critics.q.detach().max(),
            "learner_value_mean": policy.value.detach().mean(),
            "learner_target_mean": critics.target.mean(),
            "learner_reward_mean": self.config.sac.reward_scale * batch["reward"].mean(),
            "learner_entropy_nats": -policy.log_prob.mean(),
            "learner_temperature": policy.temperature,
        }

    def _step_temperature(self, log_prob: Float[Tensor, " batch"]) -> None:
        self._temperature_optimiser.zero_grad(set_to_none=True)
        self._temperature_loss(log_prob).backward()
        self._temperature_optimiser.step()

    def _temperature_loss(self, log_prob: Float[Tensor, " batch"]) -> Float[Tensor, ""]:
        return losses.temperature_loss(self.log_temperature, log_prob, self.config.sac.target_entropy)

    def _gradient_norms(self) -> dict[str, Tensor]:
        """Of the step just taken, as clipping left them."""
        norms = {
            "learner_critic_gradient_norm": self.critic.parameters(),
            "learner_encoder_gradient_norm": self.encoder.fusion_parameters(),
            "learner_value_gradient_norm": self.value.parameters(),
            "learner_actor_gradient_norm": self.actor.parameters(),
        }
        return {name: gradient_norm(parameters) for name, parameters in norms.items()}

    def _encode(self, visual: Tensor, proprio: Tensor, goal: Tensor) -> Float[Tensor, "seen latent"]:
        """Latents; with `sac.augment_views`, those of every sample's first shifted view, then of all second ones."""
        sac = self.config.sac
        if sac.augment_views:
            shifted = [random_shift(visual, sac.augment_shift_px, self._noise) for _ in range(sac.augment_views)]
            visual = torch.cat(shifted)
            proprio, goal = proprio.repeat(sac.augment_views, 1), goal.repeat(sac.augment_views, 1)
        return self.encoder(visual, proprio, goal)

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

    def load(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state; a fixed temperature is the config's, which may have changed on resuming."""
        super().load(state)
        if self.config.sac.temperature_mode != "auto":
            self._set_temperature(annealed_temperature(self.config.sac, self.updates))

    def _set_temperature(self, temperature: float) -> None:
        with torch.no_grad():
            self.log_temperature.fill_(math.log(temperature))

    def _loose_tensors(self) -> dict[str, Tensor]:
        return {"log_temperature": self.log_temperature}


def annealed_temperature(sac: SacConfig, updates: int) -> float:
    """The temperature after so many updates, when it is not tuned: constant, or falling geometrically."""
    if sac.temperature_mode != "annealed":
        return sac.temperature
    done = min(1.0, updates / sac.annealing_updates)
    return sac.temperature ** (1.0 - done) * sac.final_temperature**done
