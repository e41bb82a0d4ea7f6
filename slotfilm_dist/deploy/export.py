"""Writes a trained agent as a policy that needs nothing of this project but `deploy.loader` (`slotfilm export`)."""

import contextlib
import dataclasses
import importlib.util
import io
import json
import logging
import time
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from slotfilm_dist import __version__
from slotfilm_dist.atomic import file_digest, replace_directory
from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import load_config, to_dict
from slotfilm_dist.deploy.loader import FILES, FORMAT, MANIFEST, BackendName, PolicyInput, load_policy
from slotfilm_dist.learning.checkpoint import Checkpoint, CheckpointStore, read_checkpoint
from slotfilm_dist.learning.learner import Learner, learning_hash
from slotfilm_dist.nets.agent import AgentActor, AgentEncoder
from slotfilm_dist.nets.backbone import IMAGENET_MEAN, IMAGENET_STD

COMPARISONS = 32
"""Random observations on which a file is compared with the agent."""
TIMED_PASSES = 50
WARM_UP_PASSES = 5
ONNX_PACKAGES = ("onnx", "onnxscript", "onnxruntime")

CheckpointName = Literal["last", "best"]


class ExportedAgent(nn.Module):
    """Observation in, most likely action out: the encoder and the actor's mode in one module, for a batch of 1.

    Args:
        encoder: in eval mode.
        actor: on its latent.
        inputs: names of `forward`'s arguments, in order, out of rgb, proprio and goal.
        state_dim: size of the state, for an agent that does not read it.
    """

    unread_state: Tensor
    unread_goal: Tensor

    def __init__(self, encoder: AgentEncoder, actor: AgentActor, inputs: tuple[str, ...], state_dim: int) -> None:
        super().__init__()
        self.encoder, self.actor, self.inputs = encoder, actor, inputs
        self.register_buffer("unread_state", torch.zeros(1, state_dim))
        self.register_buffer("unread_goal", torch.zeros(1, 3))

    def forward(self, *observation: Tensor) -> Float[Tensor, "1 action"]:
        """The action in [-1, 1]; tokens are rounded to half precision on the way, as they were in training."""
        given = dict(zip(self.inputs, observation, strict=True))
        state = given.get("proprio", self.unread_state)
        visual = self.encoder.to_visual(given["rgb"]) if "rgb" in given else state.new_empty((1, 0))
        return self.actor.mode(self.encoder(visual, state, given.get("goal", self.unread_goal)))


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class ExportedFile:
    """One file of an exported policy."""

    num_bytes: int
    """Size in bytes."""
    sha256: str
    """SHA-256 of the content, 64 hex digits."""
    max_difference: float
    """Largest difference of an action from the agent's own in float32, over random observations."""
    latency_ms_mean: float
    """Mean time of `act` for one observation, on the machine and processor that exported it."""
    latency_ms_p99: float
    """99th percentile of it."""


def export_policy(
    run: Path,
    out: Path,
    *,
    formats: tuple[BackendName, ...] = ("torch", "onnx"),
    checkpoint: CheckpointName = "last",
    tolerance: float = 1e-5,
) -> dict[str, ExportedFile]:
    """Write the policy of a run's checkpoint, load it back, compare it with the agent and time it.

    It computes in float32 throughout, and is compared with the agent in float32. Where `encoder.frozen_precision` let
    the agent act in bfloat16, its actions were off from these by some thousandths.

    Args:
        run: directory of the run.
        out: directory to write; an exported policy that is there is replaced as a whole.
        formats: which files to write.
        checkpoint: the newest one, or the best of the evaluations.
        tolerance: largest difference of an action that is accepted.

    Raises:
        ValueError: there is no such checkpoint, `out` holds something else, a package is missing, or a file differs.
    """
    if out.exists() and not (out / MANIFEST).exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"{out} is there and holds no exported policy; choose another --out")
    lacking = [name for name in ONNX_PACKAGES if importlib.util.find_spec(name) is None]
    if "onnx" in formats and lacking:
        raise ValueError(
            f"--format onnx needs {', '.join(lacking)}: pip install 'slotfilm-dist[export]', or --format torch"
        )
    config = load_config(run / "config.json")
    found = _read(run / "checkpoints", config, checkpoint)
    exact = dataclasses.replace(config, encoder=dataclasses.replace(config.encoder, frozen_precision="float32"))
    learner = Learner(exact, _action_dim(config, found), torch.device("cpu"), fetch_weights=False)
    learner.load_checkpoint(found)
    inputs = policy_inputs(config)
    agent = ExportedAgent(learner.encoder, learner.rl.actor, tuple(inputs), config.obs.state_dim).eval()
    with replace_directory(out) as folder:
        program = _trace(agent, inputs)
        for backend in formats:
            _WRITERS[backend](program, folder / FILES[backend], tuple(inputs))
        manifest = _describe(config, learner, found, inputs)
        files: dict[str, ExportedFile] = {}
        for backend in formats:
            digest = file_digest(folder / FILES[backend])
            manifest["files"][backend] = to_dict(digest)
            _write_manifest(folder, manifest)
            files[backend] = _verify(folder, backend, agent, inputs, tolerance)
            manifest["files"][backend] = {"file": FILES[backend], **to_dict(files[backend])}
        _write_manifest(folder, manifest)
    return files


def policy_inputs(config: RunConfig) -> dict[str, PolicyInput]:
    """The arrays that a run's agent reads, in the order of the exported module's arguments."""
    encoder, size = config.encoder, config.env.image_size
    inputs: dict[str, PolicyInput] = {}
    if encoder.uses_image:
        inputs["rgb"] = PolicyInput(shape=(size, size, 3), dtype="uint8")
    if encoder.uses_state:
        inputs["proprio"] = PolicyInput(shape=(config.obs.state_dim,), dtype="float32")
    if encoder.goal:
        inputs["goal"] = PolicyInput(shape=(3,), dtype="float32")
    return inputs


def random_observation(
    inputs: Mapping[str, PolicyInput], rng: np.random.Generator, encoder: AgentEncoder
) -> dict[str, np.ndarray]:
    """An observation of noise: every pixel value, states as the encoder is used to, a goal in or out of view."""
    observation: dict[str, np.ndarray] = {}
    for name, wanted in inputs.items():
        if wanted.dtype == "uint8":
            observation[name] = rng.integers(0, 256, wanted.shape, dtype=np.uint8)
        elif name == "goal":
            observation[name] = np.array([*rng.random(2), rng.integers(2)], np.float32)
        else:
            mean, std = (value.cpu().numpy() for value in (encoder.proprio_mean, encoder.proprio_std))
            observation[name] = (mean + std * rng.standard_normal(wanted.shape)).astype(np.float32)
    return observation


def _read(folder: Path, config: RunConfig, which: CheckpointName) -> Checkpoint:
    if which == "best":
        return read_checkpoint(folder / "best", learning_hash(config))
    found = CheckpointStore(folder, config.checkpoint.keep).read_last(learning_hash(config))
    if found is None:
        raise ValueError(f"{folder} holds no checkpoint; the run has not trained yet")
    return found[0]


def _action_dim(config: RunConfig, checkpoint: Checkpoint) -> int:
    """Size of the action, which the config does not name: the task does, and that needs the simulator."""
    hidden = config.ddpg.hidden if config.algorithm == "ddpg" else config.sac.hidden
    name = f"actor.network.biases.{len(hidden)}"
    if name not in checkpoint.tensors:
        raise ValueError(f"checkpoint: {name} is missing")
    return checkpoint.tensors[name].shape[-1] // (1 if config.algorithm == "ddpg" else 2)


def _batch(observation: Mapping[str, np.ndarray]) -> tuple[Tensor, ...]:
    return tuple(torch.from_numpy(array[None]) for array in observation.values())


def _trace(agent: ExportedAgent, inputs: Mapping[str, PolicyInput]) -> torch.export.ExportedProgram:
    example = _batch(random_observation(inputs, np.random.default_rng(0), agent.encoder))
    with torch.no_grad():
        program = torch.export.export(agent, example)
    for node in program.graph.nodes:  # where the files lay on this machine is nobody's business
        node.meta.pop("stack_trace", None)
    return program


def _write_torch(program: torch.export.ExportedProgram, path: Path, names: tuple[str, ...]) -> None:
    program.example_inputs = None  # they would be pickled, which the loader refuses
    with _quiet():
        torch.export.save(program, path)


def _write_onnx(program: torch.export.ExportedProgram, path: Path, names: tuple[str, ...]) -> None:
    with _quiet():
        converted = torch.onnx.export(program, dynamo=True, verbose=False, input_names=names, output_names=["action"])
        assert converted is not None, "asked for by dynamo=True"
        converted.save(str(path))


_WRITERS = {"torch": _write_torch, "onnx": _write_onnx}


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Nothing on the terminal but errors: the exporters warn of what concerns their own authors."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def _describe(
    config: RunConfig, learner: Learner, checkpoint: Checkpoint, inputs: Mapping[str, PolicyInput]
) -> dict[str, Any]:
    encoder = learner.encoder
    state = {"mean": encoder.proprio_mean.tolist(), "std": encoder.proprio_std.tolist()}
    picture = {"scale": 1 / 255, "mean": IMAGENET_MEAN, "std": IMAGENET_STD}
    if config.encoder.learns_from_pixels:
        picture = {"scale": 1 / 255, "mean": (0.5 * (config.encoder.kind == "drqv2"),) * 3, "std": (1.0,) * 3}
    return {
        "format": FORMAT,
        "slotfilm_dist": __version__,
        "variant": config.variant,
        "task": config.env.task,
        "updates": learner.updates,
        "env_steps": checkpoint.values.get("limiter", {}).get("env_steps"),
        "inputs": {name: dataclasses.asdict(wanted) for name, wanted in inputs.items()},
        "state_fields": {name: config.obs.field_dim(name) for name in config.obs.state_fields},
        "action": {"size": learner.rl.actor.action_dim, "low": -1.0, "high": 1.0, "control": config.env.control_mode},
        "normalization": {
            "note": "done inside the model: (pixel * scale - mean) / std and (state - mean) / std",
            **({"rgb": picture} if "rgb" in inputs else {}),
            **({"proprio": state} if "proprio" in inputs else {}),
        },
        "files": {},
        "config": to_dict(config),
    }


def _write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _verify(
    folder: Path, backend: BackendName, agent: ExportedAgent, inputs: Mapping[str, PolicyInput], tolerance: float
) -> ExportedFile:
    """Load the written file as a robot would, compare it with the agent, and time it."""
    policy, rng, difference = load_policy(folder, backend), np.random.default_rng(1), 0.0
    with torch.inference_mode():
        for _ in range(COMPARISONS):
            observation = random_observation(inputs, rng, agent.encoder)
            own = agent(*_batch(observation))[0].numpy()
            difference = max(difference, float(np.abs(policy.act(**observation) - own).max()))
    if not difference <= tolerance:
        raise ValueError(
            f"{FILES[backend]} differs from the agent by {difference:.1e}, more than {tolerance:.0e}; "
            "leave this format out (--format), or accept the difference (--tolerance)"
        )
    times_ms: list[float] = []
    for _ in range(WARM_UP_PASSES + TIMED_PASSES):
        observation, began_s = random_observation(inputs, rng, agent.encoder), time.perf_counter()
        policy.act(**observation)
        times_ms.append(1e3 * (time.perf_counter() - began_s))
    timed = times_ms[WARM_UP_PASSES:]
    digest = file_digest(folder / FILES[backend])
    return ExportedFile(
        num_bytes=digest.num_bytes,
        sha256=digest.sha256,
        max_difference=difference,
        latency_ms_mean=float(np.mean(timed)),
        latency_ms_p99=float(np.percentile(timed, 99)),
    )
