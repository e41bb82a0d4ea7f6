"""Who chooses the actions: the trained agent or the uniform random policy."""

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32, Shaped

from slotfilm_dist.messages import Observation
from slotfilm_dist.nets.agent import AgentActor
from slotfilm_dist.nets.interface import Encoder


@runtime_checkable
class Policy(Protocol):
    """Chooses actions. The loop that uses it: visual = policy.visual(observation); policy.act(observation, visual)."""

    backbone_hash: str

    @property
    def version(self) -> int:
        """Of the weights that act; -1 without any."""
        ...

    def visual(self, observation: Observation) -> Shaped[np.ndarray, "envs *visual"]:
        """What the policy sees of the pictures and replay stores of them."""
        ...

    def act(
        self, observation: Observation, visual: Shaped[np.ndarray, "envs *visual"]
    ) -> Float32[np.ndarray, "envs action"]:
        """Actions in [-1, 1]."""
        ...


class RandomPolicy:
    """Uniform actions, as in the paper's first 100,000 steps; keeps the pictures.

    Args:
        action_dim: size of the action.
        seed: of the actions.
    """

    version = -1
    backbone_hash = ""

    def __init__(self, action_dim: int, seed: np.random.SeedSequence) -> None:
        self._action_dim = action_dim
        self._rng = np.random.default_rng(seed)

    def visual(self, observation: Observation) -> Shaped[np.ndarray, "envs *visual"]:
        """The pictures themselves, or nothing without a camera."""
        return stored_pictures(observation)

    def act(
        self, observation: Observation, visual: Shaped[np.ndarray, "envs *visual"]
    ) -> Float32[np.ndarray, "envs action"]:
        """Independent uniform actions in [-1, 1]."""
        return self._rng.uniform(-1, 1, (len(observation.proprio), self._action_dim)).astype(np.float32)


class AgentPolicy:
    """The trained agent's actor on its encoder.

    Args:
        encoder: with the frozen backbone; its trainable part follows `load`.
        actor: the policy head.
        seed: of the action noise.
        deterministic: act by tanh(mean), as in evaluation, instead of exploring.
    """

    def __init__(
        self, encoder: Encoder, actor: AgentActor, seed: np.random.SeedSequence, *, deterministic: bool = False
    ) -> None:
        self.encoder = encoder
        self.actor = actor
        self.deterministic = deterministic
        self.version = 0
        self.backbone_hash = encoder.backbone_hash() if encoder.visual_kind == "tokens" else ""
        self._device = next(actor.parameters()).device
        self._noise = torch.Generator().manual_seed(int(seed.generate_state(1)[0]))

    @torch.inference_mode()
    def visual(self, observation: Observation) -> Shaped[np.ndarray, "envs *visual"]:
        """Tokens in half precision, pictures, or nothing, as the encoder wants them."""
        if self.encoder.visual_kind == "none":
            return np.empty((len(observation.proprio), 0), np.uint8)
        # The agent acts on the rounded tokens that replay keeps, so that acting and learning see the same numbers.
        pictures = torch.from_numpy(stored_pictures(observation)).to(self._device)
        return self.encoder.to_visual(pictures).cpu().numpy()

    @torch.inference_mode()
    def act(
        self, observation: Observation, visual: Shaped[np.ndarray, "envs *visual"]
    ) -> Float32[np.ndarray, "envs action"]:
        """Sampled, or most likely, actions."""
        tensors = (torch.from_numpy(x).to(self._device) for x in (visual, observation.proprio, observation.goal))
        latent = self.encoder(*tensors)
        if self.deterministic:
            return self.actor.mode(latent).cpu().numpy()
        noise = torch.randn(len(latent), self.actor.action_dim, generator=self._noise).to(self._device)
        return self.actor.explore(latent, noise).cpu().numpy()

    def load(self, version: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over published weights."""
        actor = {k.removeprefix("actor."): torch.tensor(v) for k, v in arrays.items() if k.startswith("actor.")}
        self.actor.load_state_dict(actor)
        self.encoder.load_acting_state(
            {k.removeprefix("encoder."): v for k, v in arrays.items() if k.startswith("encoder.")}
        )
        self.version = version

    def save_noise(self) -> str:
        """State of the action noise, as hexadecimal digits."""
        return self._noise.get_state().numpy().tobytes().hex()

    def load_noise(self, state: str) -> None:
        """Continue the action noise."""
        self._noise.set_state(torch.frombuffer(bytearray.fromhex(state), dtype=torch.uint8))


def stored_pictures(observation: Observation) -> Shaped[np.ndarray, "envs *visual"]:
    """The pictures, or an empty column without a camera."""
    if observation.rgb is None:
        return np.empty((len(observation.proprio), 0), np.uint8)
    return observation.rgb
