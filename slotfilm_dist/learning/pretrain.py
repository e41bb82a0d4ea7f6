"""Supervised slot pre-training on frames of a random policy (Section 4.3)."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float16, Int, Shaped
from torch import Tensor, nn

from slotfilm_dist.config import PretrainConfig
from slotfilm_dist.learning.frames import PretrainFrames, mean_position, split_by_episode
from slotfilm_dist.learning.perception_losses import pretrain_losses
from slotfilm_dist.learning.perception_quality import (
    PerceptionQuality,
    only_slots,
    perception_quality,
    strongest_slots,
)
from slotfilm_dist.learning.rows import Rows
from slotfilm_dist.machine import takes_bfloat16
from slotfilm_dist.nets.backbone import FEATURE_CHANNELS
from slotfilm_dist.nets.capture import Capture, Feed
from slotfilm_dist.nets.encoder import SlotFusionEncoder
from slotfilm_dist.nets.perception import Perception

_FORWARD_BATCH = 128
_PERCEPTION = "perception."
_ADAM_MOMENTS = ("exp_avg", "exp_avg_sq")


class Pretrainer:
    """Trains an encoder's perception; FiLM and gate get no gradient, so RL starts from the exact identity.

    The loop that uses it:

        while pretrainer.num_steps < config.steps:
            metrics = pretrainer.step()
            if pretrainer.num_steps % config.eval_every == 0:
                quality = pretrainer.evaluate()

    With `pretrain.train_backbone = none` the backbone runs once over all frames, in a fixed eval mode, and its float16
    features stay in memory (32 KB per 128 x 128 frame); every step afterwards is cheap. The batch of step i depends on
    seed and i alone, so a resumed run draws the same batches without any saved random state.

    Args:
        encoder: trained in place; has a camera and an unfrozen backbone.
        frames: of at least two episodes.
        config: lengths, weights and rates.
        seed: of the split and of the batches.
        device: where it runs.
        cuda_graphs: on a GPU, record the step.
        max_eval_frames: held-out frames that `evaluate` looks at, spread evenly.

    Raises:
        ValueError: fewer than two episodes, or pictures of another size than the encoder's.
    """

    def __init__(
        self,
        encoder: SlotFusionEncoder,
        frames: PretrainFrames,
        config: PretrainConfig,
        *,
        seed: int,
        device: torch.device | str = "cpu",
        cuda_graphs: bool = True,
        max_eval_frames: int = 1024,
    ) -> None:
        assert encoder.perception is not None, "an encoder without a camera has nothing to pre-train"
        assert not encoder.perception.frozen, "the backbone is frozen: it has been pre-trained already"
        self.encoder, self.network = encoder.to(device), encoder.perception
        self.frames, self.config, self.device = frames, config, torch.device(device)
        self.num_steps = 0
        """Gradient steps done."""
        self._image_size = self.network.image_size
        self._half = _takes_bfloat16(config.precision, self.device)
        if frames.rgb.shape[1:3] != (self._image_size, self._image_size):
            raise ValueError(f"env.image_size = {self._image_size}: the frames are {frames.rgb.shape[1:3]} pixels")
        self._seed = seed
        self.train_frames, held_out = split_by_episode(frames.episode, config.holdout, seed)
        """Frames that are trained on."""
        spread = np.linspace(0, len(held_out) - 1, min(max_eval_frames, len(held_out))).astype(np.int64)
        self.eval_frames = held_out[spread]
        """Frames of other episodes that `evaluate` looks at."""
        self._mean_position = torch.from_numpy(mean_position(frames, self.train_frames)).to(self.device)
        self._rows: Rows | None = None
        self._feed: Feed | None = None
        self._trained = self._trained_parameters()
        on_gpu = self.device.type == "cuda"
        self._optimizer = torch.optim.Adam(self._trained.values(), lr=config.lr, fused=True, capturable=on_gpu)
        self._cuda_graphs = cuda_graphs
        self._record_anew()
        self._losses = torch.full((4,), math.nan)

    def step(self) -> dict[str, float]:
        """One gradient step on a random batch of training frames; returns the losses by metric name.

        Raises:
            ValueError: the loss is no longer finite.
        """
        self.begin_step()
        return self.losses()

    def begin_step(self) -> None:
        """One gradient step, without waiting for a GPU to make it."""
        rng = np.random.default_rng([self._seed, self.num_steps])
        chosen = np.sort(rng.choice(self.train_frames, self.config.batch_size))  # sorted: a file is read forwards
        batch = self._batch(chosen)
        if self._feed is None:
            self._feed = Feed(batch, self.device)
        self._feed.fill(batch)
        self._losses = self._descend()
        self.num_steps += 1

    def losses(self) -> dict[str, float]:
        """The last step's losses by metric name.

        Raises:
            ValueError: the loss is no longer finite.
        """
        total, position, visibility, attention = self._losses.tolist()
        if not math.isfinite(total):
            raise ValueError(f"pre-training diverged by step {self.num_steps} (loss {total}): lower pretrain.lr")
        return {
            "pretrain_loss": total,
            "pretrain_position_loss": position,
            "pretrain_visibility_loss": visibility,
            "pretrain_attention_loss": attention,
        }

    def _take_step(self) -> Float[Tensor, "4"]:
        """Descend on the fed batch; gives the total loss, then its parts."""
        assert self._feed is not None
        batch = self._feed.tensors
        losses = pretrain_losses(
            self._perceive(batch["seen"], training=True),
            batch["uv"],
            batch["visible"],
            self.config,
            image_size=self._image_size,
            matched_visibility=self.network.matched_visibility,
        )
        self._optimizer.zero_grad(set_to_none=True)
        losses.total.backward()
        self._optimizer.step()
        return torch.stack((losses.total, losses.position, losses.visibility, losses.attention)).detach()

    @torch.no_grad()
    def evaluate(self) -> PerceptionQuality:
        """How well frames of held-out episodes are understood; the baseline predicts the training frames' mean."""
        parts = [self._perceive(self._seen(chosen), training=False) for chosen in _batches(self.eval_frames)]
        perception = Perception(
            slots=torch.cat([part.slots for part in parts]),
            attention=torch.cat([part.attention for part in parts]),
            uv=torch.cat([part.uv for part in parts]),
            visible_logits=torch.cat([part.visible_logits for part in parts]),
        )
        counted = strongest_slots(perception.attention.cpu().numpy(), self.frames.uv.shape[1])
        return perception_quality(
            only_slots(perception, counted, matched_visibility=self.network.matched_visibility),
            torch.from_numpy(self.frames.uv[self.eval_frames]).to(self.device),
            torch.from_numpy(self.frames.visible[self.eval_frames]).to(self.device),
            self._mean_position,
            image_size=self._image_size,
            matched_visibility=self.network.matched_visibility,
        )

    def save(self) -> dict[str, Any]:
        """The perception's weights, Adam's moments and the step, as nested dicts of arrays and scalars.

        Fusion and gate are left out, so that an agent with others can take it over and go on with it.
        """
        moments = {
            name: {key: _array(self._optimizer.state[parameter][key]) for key in _ADAM_MOMENTS}
            for name, parameter in self._trained.items()
            if parameter in self._optimizer.state
        }
        weights = {_PERCEPTION + name: _array(value) for name, value in self.network.state_dict().items()}
        return {"num_steps": self.num_steps, "seed": self._seed, "weights": weights, "adam": moments}

    def load(self, state: Mapping[str, Any]) -> None:
        """Continue a saved pre-training as if it had never stopped.

        Raises:
            ValueError: it was saved by another encoder, with another seed, or trained other parameters.
        """
        if state["seed"] != self._seed:
            raise ValueError(f"seed = {self._seed}: the saved pre-training has seed {state['seed']}; resume with that")
        if state["adam"] and state["adam"].keys() != self._trained.keys():
            raise ValueError(
                "pretrain.train_backbone: the saved pre-training trained other parameters; resume with its"
            )
        weights = {
            name.removeprefix(_PERCEPTION): torch.from_numpy(np.array(value))
            for name, value in state["weights"].items()
            if name.startswith(_PERCEPTION)
        }
        try:
            self.network.load_state_dict(weights)
        except RuntimeError as error:
            raise ValueError(f"the saved pre-training belongs to another encoder: {error}") from None
        self.num_steps = int(state["num_steps"])
        self._optimizer.state.clear()
        for name, moments in state["adam"].items():
            self._optimizer.state[self._trained[name]] = self._adam_state(self._trained[name], moments)
        self._rows = None
        self._record_anew()

    def _record_anew(self) -> None:
        """Forget the step's graph, which holds the optimiser's tensors."""
        self._descend = Capture(self._take_step, self.device) if self._cuda_graphs else self._take_step

    def _adam_state(self, parameter: nn.Parameter, moments: Mapping[str, Any]) -> dict[str, Tensor]:
        """Adam's state in the parameter's own memory layout, which its fused kernel takes for granted."""
        state = {"step": torch.tensor(float(self.num_steps), device=self.device)}
        for key in _ADAM_MOMENTS:
            state[key] = torch.empty_like(parameter, requires_grad=False)
            state[key].copy_(torch.from_numpy(np.array(moments[key])))
        return state

    def _trained_parameters(self) -> dict[str, nn.Parameter]:
        """What is trained, by name: perception, with or without the backbone; never FiLM, gate or concatenation."""
        with_backbone = self.config.train_backbone == "all"
        named = dict(self.network.named_parameters())
        return {name: value for name, value in named.items() if with_backbone or not name.startswith("backbone.")}

    def _perceive(self, seen: Shaped[Tensor, "batch ..."], *, training: bool) -> Perception:
        """The network's view of frames as `_seen` gives them; BatchNorm of a trained backbone follows `training`."""
        rows = self._all_rows().on_device(seen)
        if self.config.train_backbone == "none":
            return self.network(self.network.projection(rows.float()))
        self.encoder.train(training)
        with torch.autocast(self.device.type, torch.bfloat16, self._half, cache_enabled=False):
            tokens = self.network.tokens(rows)
        return self.network(tokens.float())

    def _batch(self, chosen: Int[np.ndarray, " batch"]) -> dict[str, np.ndarray]:
        """What a step needs of some frames."""
        return {
            "seen": self._all_rows().take(chosen),
            "uv": self.frames.uv[chosen],
            "visible": self.frames.visible[chosen],
        }

    def _seen(self, chosen: Int[np.ndarray, " batch"]) -> Shaped[Tensor, "batch ..."]:
        return torch.from_numpy(self._all_rows().take(chosen)).to(self.device)

    def _all_rows(self) -> Rows:
        """The pictures, or the unchanging backbone's features of every frame, computed at the first call."""
        if self._rows is None:
            whole = self.config.train_backbone == "all"
            self._rows = Rows(self.frames.rgb if whole else self._features(), self.device)
        return self._rows

    @torch.no_grad()
    def _features(self) -> Float16[np.ndarray, "frames tokens channels"]:
        self.encoder.eval()
        rgb = self.frames.rgb
        features = np.empty((len(rgb), self.network.grid_size**2, FEATURE_CHANNELS), np.float16)
        for chosen in _batches(np.arange(len(rgb))):
            pictures = torch.from_numpy(np.asarray(rgb[chosen])).to(self.device)
            features[chosen] = self.network.frozen_features(pictures).half().cpu().numpy()
        return features


def _takes_bfloat16(precision: str, device: torch.device) -> bool:
    if device.type == "cuda" and precision == "auto":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return takes_bfloat16(precision)


def _batches(chosen: Int[np.ndarray, " frames"]) -> list[Int[np.ndarray, " batch"]]:
    return np.array_split(chosen, math.ceil(len(chosen) / _FORWARD_BATCH))


def _array(value: Tensor) -> np.ndarray:
    """An independent copy."""
    return value.detach().cpu().contiguous().numpy().copy()
