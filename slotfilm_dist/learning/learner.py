"""The learner's role from the first picture to the last update: pre-training, RL, weights for the workers, checkpoints.

Who drives it, in one process or through an actor:

    learner = Learner(config, action_dim, device)
    learner.begin_pretraining(dataset)
    while learner.pretrain_steps < config.pretrain.steps:
        metrics = learner.pretrain(num_steps=50)
    learner.begin_rl(dataset)
    for block in learner.stored_blocks(dataset):          # random-policy data as replay keeps it
        store.insert(block)
    while ...:
        learner.update(batches)
        snapshot = learner.snapshot()
"""

import dataclasses
import time
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
import torch

from slotfilm_dist.config import TEMPERATURE_FIELDS, DdpgConfig, RunConfig, SacConfig, check
from slotfilm_dist.config_files import config_hash
from slotfilm_dist.envs.reward import rewards_of
from slotfilm_dist.learning.checkpoint import Checkpoint, plain_tensors
from slotfilm_dist.learning.ddpg import DdpgLearner
from slotfilm_dist.learning.frames import PretrainFrames
from slotfilm_dist.learning.graphed_sac import GraphedSac
from slotfilm_dist.learning.pretrain import Pretrainer
from slotfilm_dist.learning.sac import SacLearner
from slotfilm_dist.learning.state_scale import state_scale
from slotfilm_dist.machine import has_c_compiler
from slotfilm_dist.messages import SampleBatch, TransitionBlock, WeightSnapshot
from slotfilm_dist.nets.agent import AgentEncoder, build_encoder
from slotfilm_dist.nets.encoder import SlotFusionEncoder
from slotfilm_dist.nets.interface import Encoder
from slotfilm_dist.nets.pixel_encoder import PixelEncoder
from slotfilm_dist.replay.dataset import FrameDataset
from slotfilm_dist.replay.schema import ReplaySchema
from slotfilm_dist.seeds import Role, role_number, role_seed

RlLearner = SacLearner | DdpgLearner

LOSSES_EVERY = 10
"""Pre-training steps between readings of the losses, for each of which the learner waits for the GPU."""
ENCODE_ROWS = 256
"""Rows of random-policy data encoded at once."""
STATE_ROWS = 200_000
"""Rows that the state's statistics are taken from."""


def pretrain_hash(config: RunConfig) -> str:
    """Names the pre-trained encoder: the fields that it depends on, and no others."""
    encoder = dataclasses.replace(config.encoder, fusion="film_tanh", goal=False)
    identity = data_identity(config) | picture_identity(config)
    ending = (config.success,) if config.env.terminate_on_success else ()
    return config_hash(config.env, config.obs.num_objects, encoder, config.pretrain, identity, *ending)


def picture_identity(config: RunConfig) -> dict[str, Any]:
    """What pictures depend on beside `env` and `success`: the target's radius where it is seen or ends episodes."""
    matters = config.env.goal_visible or config.env.terminate_on_success
    return {"delta_m": config.reward.delta_m} if matters else {}


def data_identity(config: RunConfig) -> dict[str, Any]:
    """What the random policy's pictures depend on beside `env`."""
    schedule = config.schedule
    return {
        "seed": config.seed,
        "random_steps": schedule.random_steps,
        "random_episode_steps": schedule.random_episode_steps,
    }


class Learner:
    """Holds the encoder and the RL on it: SAC, or DrQ-v2's own algorithm.

    Args:
        config: the run.
        action_dim: size of the action.
        device: where it computes.
        fetch_weights: fill the backbone as `encoder.backbone` asks; False where a checkpoint fills it right after.

    Raises:
        ValueError: the backbone's weights cannot be had, or updates cannot be compiled here.
    """

    def __init__(self, config: RunConfig, action_dim: int, device: torch.device, *, fetch_weights: bool = True) -> None:
        self.config = config
        self.device = device
        self._action_dim = action_dim
        compiles = config.runtime.compiled and device.type == "cuda"
        needs = "needs a C compiler where the learner runs, for instance the package gcc; or leave it away"
        check(not compiles or has_c_compiler(), "runtime.compiled", config.runtime.compiled, needs)
        self.encoder: AgentEncoder = build_encoder(config, fetch_weights=fetch_weights).to(device)
        self._pretrainer: Pretrainer | None = None
        self._rl: RlLearner | None = None

    @property
    def rl(self) -> RlLearner:
        """The RL half; exists after `begin_rl`."""
        assert self._rl is not None, "begin_rl comes first"
        return self._rl

    @property
    def pretrain_steps(self) -> int:
        """Gradient steps of pre-training done."""
        return self._pretrainer.num_steps if self._pretrainer else 0

    @property
    def updates(self) -> int:
        """Updates done."""
        return self._rl.updates if self._rl else 0

    def begin_pretraining(self, dataset: FrameDataset) -> None:
        """Get ready to pre-train on the random policy's pictures."""
        frames = PretrainFrames(rgb=dataset.rgb, uv=dataset.uv, visible=dataset.visible, episode=dataset.episode)
        self._pretrainer = Pretrainer(
            self._slots,
            frames,
            self.config.pretrain,
            seed=role_number(self.config.seed, Role.PRETRAIN),
            device=self.device,
            cuda_graphs=self.config.runtime.cuda_graphs,
        )

    def pretrain(self, num_steps: int) -> dict[str, float]:
        """Take gradient steps; gives the last losses, and held-out errors where an evaluation was due."""
        trainer, config = self._pretrainer, self.config.pretrain
        assert trainer is not None, "begin_pretraining comes first"
        metrics: dict[str, float] = {}
        started = time.monotonic()
        last = min(trainer.num_steps + num_steps, config.steps)
        while trainer.num_steps < last:
            trainer.begin_step()
            if trainer.num_steps % LOSSES_EVERY == 0 or trainer.num_steps == last:
                metrics |= trainer.losses()
            if trainer.num_steps % config.eval_every == 0 or trainer.num_steps == config.steps:
                metrics |= trainer.evaluate().metrics()
        metrics["pretrain_steps_total"] = trainer.num_steps
        metrics["pretrain_steps_per_s"] = num_steps / (time.monotonic() - started)
        return metrics

    def pretrain_state(self) -> Checkpoint:
        """The pre-training so far, or its result."""
        trainer = self._pretrainer
        assert trainer is not None, "begin_pretraining comes first"
        state = trainer.save()
        tensors = {f"weights.{k}": torch.from_numpy(np.asarray(v)) for k, v in state["weights"].items()}
        for name, moments in state["adam"].items():
            tensors |= {f"adam.{name}/{key}": torch.from_numpy(np.asarray(v)) for key, v in moments.items()}
        values = {"num_steps": state["num_steps"], "seed": state["seed"]}
        return Checkpoint(tensors=plain_tensors(tensors), values=values, config_hash=pretrain_hash(self.config))

    def load_pretrain_state(self, checkpoint: Checkpoint) -> None:
        """Continue a pre-training; `begin_pretraining` comes first."""
        trainer = self._pretrainer
        assert trainer is not None, "begin_pretraining comes first"
        adam: dict[str, dict[str, np.ndarray]] = {}
        weights: dict[str, np.ndarray] = {}
        for name, value in checkpoint.tensors.items():
            kind, _, rest = name.partition(".")
            if kind == "weights":
                weights[rest] = value.numpy()
            else:
                parameter, _, key = rest.rpartition("/")
                adam.setdefault(parameter, {})[key] = value.numpy()
        trainer.load({**checkpoint.values, "weights": weights, "adam": adam})

    def load_pretrained(self, checkpoint: Checkpoint) -> None:
        """Take over the perception of a finished pre-training; fusion and gate keep their own initial values."""
        prefix = "weights.perception."
        perception = self._slots.perception
        assert perception is not None, "an agent without a camera has nothing to load"
        saved = {k.removeprefix(prefix): v for k, v in checkpoint.tensors.items() if k.startswith(prefix)}
        try:
            perception.load_state_dict(saved)
        except RuntimeError as error:
            raise ValueError(f"the pre-trained encoder does not fit this agent: {error}") from None

    def begin_rl(self, dataset: FrameDataset | None) -> None:
        """Freeze the backbone unless it is trained end to end, take the state's statistics, and build the RL half."""
        config = self.config
        fusion = getattr(self.encoder, "fusion", None)
        assert fusion is None or fusion.is_identity(), "pre-training must leave FiLM at zero"
        if not config.sac.end_to_end:
            self.encoder.freeze_backbone()
        self.encoder.eval()
        if config.obs.normalize_state and dataset is not None:
            mean, std = state_scale(config.obs, dataset.proprio[:STATE_ROWS])
            self.encoder.set_state_statistics(
                torch.from_numpy(mean).to(self.device), torch.from_numpy(std).to(self.device)
            )
        self._pretrainer = None
        self._rl = build_rl(config, self.encoder, self._action_dim, self.device)

    @property
    def _slots(self) -> SlotFusionEncoder:
        assert isinstance(self.encoder, SlotFusionEncoder), "pixel encoders are not pre-trained"
        return self.encoder

    def schema(self) -> ReplaySchema:
        """How this agent's transitions are stored."""
        return replay_schema(self.config, self.encoder, self._action_dim)

    def stored_blocks(self, dataset: FrameDataset) -> Iterator[TransitionBlock]:
        """The random policy's data as replay keeps it: pictures become tokens once, here, and get this run's reward."""
        backbone_hash = self.schema().backbone_hash
        for block in dataset.blocks(ENCODE_ROWS, partial(rewards_of, config=self.config.reward)):
            yield dataclasses.replace(block, visual=self._stored_visual(block.visual), backbone_hash=backbone_hash)

    @torch.inference_mode()
    def _stored_visual(self, pictures: np.ndarray) -> np.ndarray:
        if self.encoder.visual_kind == "none":
            return np.empty((len(pictures), 0), np.uint8)
        return self.encoder.to_visual(torch.from_numpy(np.array(pictures)).to(self.device)).cpu().numpy()

    def update(self, batch: SampleBatch) -> None:
        """One update of every network."""
        self.rl.update(batch)

    def settle(self) -> None:
        """Wait for updates under way; `updates` may fall by those that were skipped."""
        self.rl.settle()

    def metrics(self) -> dict[str, float]:
        """The latest measurements of RL, and the GPU's memory."""
        on_gpu = self.device.type == "cuda"
        memory = {"run_gpu_memory_bytes": float(torch.cuda.memory_allocated(self.device))} if on_gpu else {}
        return self.rl.metrics() | memory

    def snapshot(self) -> WeightSnapshot:
        """What workers need to act now."""
        arrays = self.rl.acting_arrays()  # first: on a GPU it finds out which updates were made
        return WeightSnapshot(version=self.updates, published_at_s=time.time(), arrays=arrays)

    def checkpoint(self, values: Mapping[str, Any]) -> Checkpoint:
        """Everything that the next update depends on, with the caller's own plain values beside it."""
        state = self.rl.save()
        own = {"updates": state["updates"], "skipped_updates": state["skipped_updates"]}
        return Checkpoint(tensors=state["tensors"], values=own | dict(values), config_hash=learning_hash(self.config))

    def load_checkpoint(self, checkpoint: Checkpoint) -> None:
        """Continue from a checkpoint, also one written by an agent that is built anew.

        Raises:
            ValueError: it does not fit this agent.
        """
        if self._rl is None:
            self.begin_rl(None)
        self.rl.load({"tensors": checkpoint.tensors, **checkpoint.values})


def learning_hash(config: RunConfig) -> str:
    """Names what a checkpoint needs to be read: all but budgets, places, rates, temperature and the reward.

    A resume may change budgets, places, rates and temperature; `runs.resumed_config` refuses the rest.
    """
    own = (dataclasses.replace(config.ddpg, lr=DdpgConfig().lr),) if config.algorithm == "ddpg" else ()
    sac = dataclasses.replace(config.sac, **{name: getattr(SacConfig(), name) for name in TEMPERATURE_FIELDS})
    return config_hash(config.variant, config.seed, config.env, config.obs, config.encoder, sac, *own)


def build_rl(config: RunConfig, encoder: AgentEncoder, action_dim: int, device: torch.device) -> RlLearner:
    """The algorithm that a config asks for, on an encoder that is ready for RL."""
    seed = role_seed(config.seed, Role.LEARNER)
    if config.algorithm == "ddpg":
        assert isinstance(encoder, PixelEncoder), "the config allows DrQ-v2's encoder only"
        return DdpgLearner(config, encoder, action_dim, seed, device)
    graphed = device.type == "cuda" and encoder.visual_kind != "rgb" and config.runtime.cuda_graphs
    return (GraphedSac if graphed else SacLearner)(config, encoder, action_dim, seed, device)


def replay_schema(config: RunConfig, encoder: Encoder, action_dim: int) -> ReplaySchema:
    """How an agent's transitions are stored, given its encoder."""
    size = config.env.image_size
    kind = encoder.visual_kind
    shapes = {"tokens": ((size // 16) ** 2, config.encoder.feature_dim), "rgb": (size, size, 3), "none": (0,)}
    return ReplaySchema(
        visual_kind=kind,
        visual_shape=shapes[kind],
        proprio_dim=config.obs.state_dim,
        action_dim=action_dim,
        num_objects=config.obs.num_objects,
        backbone_hash=encoder.backbone_hash() if kind == "tokens" else "",
    )


def dataset_schema(config: RunConfig, action_dim: int, num_reward_inputs: int = 0) -> ReplaySchema:
    """How the random policy's data are stored: pictures with labels or none, the reward or what it follows from."""
    size = config.env.image_size
    image = config.encoder.uses_image
    return ReplaySchema(
        visual_kind="rgb" if image else "none",
        visual_shape=(size, size, 3) if image else (0,),
        proprio_dim=config.obs.state_dim,
        action_dim=action_dim,
        num_objects=config.obs.num_objects,
        store_labels=True,
        num_reward_inputs=num_reward_inputs,
    )


def dataset_hash(config: RunConfig) -> str:
    """Names the random policy's data: the fields that it depends on, and no others.

    Of `reward` that is only the target's radius, which can be seen and decides success; success can end an episode.
    """
    identity = data_identity(config) | {"camera": config.encoder.uses_image, "delta_m": config.reward.delta_m}
    return config_hash(config.env, config.obs.state_fields, config.success, identity)
