"""DrQ-v2's learner (Yarats et al. 2021, "Mastering Visual Continuous Control", Section 3.1; Appendix A.5).

Point by point, with the released code as witness where the text is silent:

published                                               here
deterministic policy gradient, no entropy term          the same
clipped double Q: the target's smaller critic           the same, also in the actor's loss, as in the code
n-step returns, n = 3                                   the same, `ddpg.num_steps`; the sums are formed in replay
noise N(0, sigma^2), sigma falling linearly from 1.0    the same, in environment steps; they are counted from the
to 0.1 over 500k steps (the text's medium tasks)        updates and `schedule.updates_per_step`
noise clipped to 0.3 in both losses, not when acting    the same
random shift, pad 4, with bilinear interpolation        the same; see `augment.random_shift_bilinear` for text and code
convolutions as DrQ's, actor and critics with a trunk   the same; see `nets.pixel_encoder`, `nets.deterministic_heads`
(linear to 50, LayerNorm, tanh) of their own
encoder trained by the critics' loss only; the next     the same
picture goes through the same, online encoder
target critics with Polyak rate 0.01, trunk included    the same
Adam 1e-4, 1024 x 1024 layers, replay 1 M               the same; Table A1's batch of 128 times 2 is the published 256
an update every 2nd step                                the same: the variant halves `schedule.updates_per_step`

Departures:
- 2000 epochs of 400 steps, 800k steps, as in Figure A1. The first 100k are those of the random policy that all agents
  share, instead of 4k frames of exploration.
- One picture and no action repeat instead of three pictures and a repeat of 2.
- The reward is scaled by `sac.reward_scale` ("under the same reward scaling", Figure A1).
- A window that meets the end of an episode or of a worker's block adds up fewer rewards and bootstraps from the frame
  there, with the discount that belongs to it. The code leaves out an episode's last n - 1 starts instead.
- `drqv2_state` appends the state behind the trunks, which the publication does not have.
"""

import copy

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from slotfilm_dist.config import RunConfig
from slotfilm_dist.learning import losses
from slotfilm_dist.learning.augment import random_shift, random_shift_bilinear
from slotfilm_dist.learning.off_policy import METRICS_EVERY, OffPolicyLearner, gradient_norm
from slotfilm_dist.messages import SampleBatch
from slotfilm_dist.nets.agent import build_actor
from slotfilm_dist.nets.deterministic_heads import DeterministicActor, TrunkTwinCritic
from slotfilm_dist.nets.pixel_encoder import PixelEncoder

ADVICE = "lower ddpg.lr or sac.reward_scale"


class DdpgLearner(OffPolicyLearner[DeterministicActor]):
    """Holds encoder, actor, critics and target critics and improves them batch by batch.

    Args:
        config: the run; `ddpg`, `sac`, `schedule` and `encoder` matter here.
        encoder: DrQ-v2's convolutions, trained by the critics' gradient only.
        action_dim: size of the action.
        seed: root of the initial weights, the shifts and the noise.
        device: where to compute.
    """

    def __init__(
        self,
        config: RunConfig,
        encoder: PixelEncoder,
        action_dim: int,
        seed: np.random.SeedSequence,
        device: torch.device,
    ) -> None:
        init_seed, noise_seed = (int(s.generate_state(1)[0]) for s in seed.spawn(2))
        super().__init__(encoder, noise_seed, device)
        self.config = config
        generator = torch.Generator().manual_seed(init_seed)
        actor = build_actor(config, encoder, action_dim, generator)
        assert isinstance(actor, DeterministicActor)
        self.actor = actor.to(device)
        self.critic = TrunkTwinCritic(
            encoder.visual_dim,
            encoder.state_dim,
            action_dim,
            feature_dim=config.encoder.feature_dim,
            hidden=config.ddpg.hidden,
            generator=generator,
        ).to(device)
        self.target_critic = copy.deepcopy(self.critic).requires_grad_(False)
        critic_side = [*self.critic.parameters(), *self.encoder.fusion_parameters()]
        self._critic_optimiser = torch.optim.Adam(critic_side, lr=config.ddpg.lr, fused=True)
        self._actor_optimiser = torch.optim.Adam(self.actor.parameters(), lr=config.ddpg.lr, fused=True)
        self._targets = [p.data for p in self.target_critic.parameters()]
        self._online = [p.data for p in self.critic.parameters()]
        self.actor.noise_std.fill_(self.noise_std)

    @property
    def env_steps(self) -> float:
        """Environment steps of the run, as its number of updates tells them."""
        schedule = self.config.schedule
        return schedule.random_steps + self.updates / schedule.updates_per_step

    @property
    def noise_std(self) -> float:
        """Deviation of the exploration noise now."""
        ddpg = self.config.ddpg
        done = min(1.0, self.env_steps / ddpg.std_steps)
        return (1.0 - done) * ddpg.first_std + done * ddpg.last_std

    def update(self, batch: SampleBatch) -> None:
        """One gradient step of critics and encoder, then of the actor, then of the target critics.

        Raises:
            TrainingDivergedError: loss or gradient was not finite `MAX_SKIPPED` times in a row.
        """
        ddpg, sac = self.config.ddpg, self.config.sac
        self.actor.noise_std.fill_(self.noise_std)
        action, terminated, truncated, discount = (
            self._tensor(x) for x in (batch.action, batch.terminated, batch.truncated, batch.discount)
        )
        reward = self._tensor(batch.reward) * sac.reward_scale
        latent = self._encode(batch.visual, batch.proprio, batch.goal)
        with torch.no_grad():
            next_latent = self._encode(batch.next_visual, batch.next_proprio, batch.next_goal)
            next_action = self.actor(next_latent, self._draw(action), ddpg.noise_clip)
            next_value = self.target_critic(next_latent, next_action).amin(dim=0)
            mask = losses.bootstrap_mask(terminated, truncated, sac.bootstrap)
            target = reward + discount * mask * next_value
        q = self.critic(latent, action)
        # Squared errors, not half of them as in SAC.
        critic_loss = 2 * losses.critic_loss(q, target)
        if not self._descend(self._critic_optimiser, critic_loss, sac.grad_clip, ADVICE):
            return

        seen = latent.detach()
        actor_loss = (
            -self.critic(seen, self.actor(seen, self._draw(action), ddpg.noise_clip), frozen=True).amin(0).mean()
        )
        if not self._descend(self._actor_optimiser, actor_loss, 0.0, ADVICE):
            return
        losses.polyak(self._targets, self._online, ddpg.tau)
        self._count_update()
        if self.updates % METRICS_EVERY == 0:
            self._metrics = {
                "learner_critic_loss": critic_loss.detach(),
                "learner_actor_loss": actor_loss.detach(),
                "learner_q_mean": q.detach().mean(),
                "learner_target_mean": target.mean(),
                "learner_policy_std": self.actor.noise_std.clone(),
                "learner_critic_gradient_norm": gradient_norm(self.critic.parameters()),
                "learner_encoder_gradient_norm": gradient_norm(self.encoder.fusion_parameters()),
                "learner_actor_gradient_norm": gradient_norm(self.actor.parameters()),
            }

    def modules(self) -> dict[str, torch.nn.Module]:
        """Every network by name, for checkpoints."""
        return {
            "encoder": self.encoder,
            "actor": self.actor,
            "critic": self.critic,
            "target_critic": self.target_critic,
        }

    def _optimisers(self) -> dict[str, torch.optim.Optimizer]:
        return {"critic_optimiser": self._critic_optimiser, "actor_optimiser": self._actor_optimiser}

    def _encode(self, visual: np.ndarray, proprio: np.ndarray, goal: np.ndarray) -> Float[Tensor, "batch latent"]:
        """Latents of randomly shifted pictures."""
        ddpg = self.config.ddpg
        shift = random_shift_bilinear if ddpg.shift == "bilinear" else random_shift
        shifted = shift(self._tensor(visual), ddpg.shift_px, self._noise)
        return self.encoder(shifted, self._tensor(proprio), self._tensor(goal))

    def _draw(self, action: Float[Tensor, "batch action"]) -> Float[Tensor, "batch action"]:
        return torch.randn(action.shape, generator=self._noise, device=self.device)
