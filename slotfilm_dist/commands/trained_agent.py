"""Loads the networks of a run for measurements, without simulator, critics or replay."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import load_config
from slotfilm_dist.learning.checkpoint import Checkpoint, CheckpointStore, read_checkpoint
from slotfilm_dist.learning.learner import learning_hash, pretrain_hash
from slotfilm_dist.nets.agent import AgentActor, AgentEncoder, build_actor, build_encoder
from slotfilm_dist.nets.backbone import weights_hash
from slotfilm_dist.nets.encoder import SlotFusionEncoder

Which = Literal["last", "best", "pretrained"]
WHICH: tuple[Which, ...] = ("last", "best", "pretrained")


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainedAgent:
    """Networks in eval mode, on their device."""

    run_dir: Path
    config: RunConfig
    encoder: AgentEncoder
    actor: AgentActor | None
    """None where only the pre-trained encoder was loaded."""
    which: Which
    env_steps: int
    """Environment steps that it had learned from; 0 for the pre-trained encoder."""
    updates: int
    """Updates of RL behind it."""
    weights: str
    """Names encoder and actor: the first 16 digits of a hash of their weights."""

    @property
    def has_trained_heads(self) -> bool:
        """Whether pre-training taught the UV and visibility heads anything."""
        return self.config.pretrains

    def slots(self, purpose: str) -> SlotFusionEncoder:
        """The encoder, if it has slots; raises ``ValueError`` for an agent without."""
        if not isinstance(self.encoder, SlotFusionEncoder) or self.encoder.perception is None:
            raise ValueError(
                f"{self.run_dir}: variant {self.config.variant!r} has no slots; {purpose} needs an agent that has"
            )
        return self.encoder


def load_trained_agent(run_dir: Path, which: Which, device: torch.device, artifacts: Path) -> TrainedAgent:
    """Load a run's networks.

    Args:
        run_dir: the run.
        which: newest checkpoint, the one with the best evaluation, or the encoder as pre-training left it.
        device: where they compute.
        artifacts: folder that holds pre-trained encoders.

    Raises:
        ValueError: there is no such checkpoint, or it is damaged.
    """
    config = load_config(run_dir / "config.json")
    checkpoint = _read(run_dir, config, which, artifacts)
    encoder = build_encoder(config, fetch_weights=False)
    if not config.sac.end_to_end:
        encoder.freeze_backbone()
    actor: AgentActor | None = None
    if which == "pretrained":
        _load(encoder, checkpoint, "weights.", run_dir, only="perception.")
    else:
        _load(encoder, checkpoint, "encoder.", run_dir)
        actor = build_actor(config, encoder, _action_dim(config, checkpoint, run_dir))
        _load(actor, checkpoint, "actor.", run_dir)
        actor.to(device).eval()
    encoder.to(device).eval()
    values = checkpoint.values
    return TrainedAgent(
        run_dir=run_dir,
        config=config,
        encoder=encoder,
        actor=actor,
        which=which,
        env_steps=int(values["limiter"]["env_steps"]) if "limiter" in values else 0,
        updates=int(values.get("updates", 0)),
        weights=_digest(checkpoint),
    )


def _read(run_dir: Path, config: RunConfig, which: Which, artifacts: Path) -> Checkpoint:
    folder = run_dir / "checkpoints"
    if which == "last":
        found = CheckpointStore(folder, config.checkpoint.keep).read_last(learning_hash(config))
        if found is None:
            raise ValueError(f"{folder} holds no checkpoint; the run has not trained yet")
        return found[0]
    if which == "best":
        if not (folder / "best").exists():
            raise ValueError(
                f"{folder / 'best'} does not exist: it is written by evaluations during training "
                "(evaluation.every_steps); use the newest checkpoint, last"
            )
        return read_checkpoint(folder / "best", learning_hash(config))
    if not config.pretrains:
        raise ValueError(f"{run_dir}: variant {config.variant!r} has no pre-training; use the newest checkpoint, last")
    return read_checkpoint(artifacts / f"encoder-{pretrain_hash(config)}")


def _load(module: torch.nn.Module, checkpoint: Checkpoint, prefix: str, run_dir: Path, only: str = "") -> None:
    """Fill a module with the tensors below a prefix; with `only`, just its parts of that name."""
    saved = {
        name.removeprefix(prefix): value for name, value in checkpoint.tensors.items() if name.startswith(prefix + only)
    }
    kept = {name: value for name, value in module.state_dict().items() if only and not name.startswith(only)}
    try:
        module.load_state_dict(kept | saved)
    except RuntimeError as error:
        raise ValueError(f"{run_dir}: the checkpoint does not fit its config.json: {error}") from None


def _action_dim(config: RunConfig, checkpoint: Checkpoint, run_dir: Path) -> int:
    """Size of the action, from the actor's last layer: mean and deviation of each, or the action itself."""
    biases = sorted(name for name in checkpoint.tensors if name.startswith("actor.network.biases."))
    if not biases:
        raise ValueError(f"{run_dir}: the checkpoint holds no actor")
    out = checkpoint.tensors[biases[-1]].shape[-1]
    return out if config.algorithm == "ddpg" else out // 2


def _digest(checkpoint: Checkpoint) -> str:
    """Identifies the weights that were loaded."""
    named = [(n, v) for n, v in sorted(checkpoint.tensors.items()) if n.startswith(("encoder.", "actor.", "weights."))]
    return weights_hash(named)
