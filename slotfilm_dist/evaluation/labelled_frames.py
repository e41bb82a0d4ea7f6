"""Frames of held-out episodes with the simulator's labels: what perception and probes are measured on.

They depend on the environment, the seeds and who acts, not on the agent that is measured, so every variant can be
measured on identical frames, as the paper does (Section 6.4).
"""

import dataclasses
import io
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8

from slotfilm_dist.atomic import write_atomic
from slotfilm_dist.contracts import VectorEnv
from slotfilm_dist.envs.scene import SceneState
from slotfilm_dist.policy import Policy


@runtime_checkable
class SceneEnv(VectorEnv, Protocol):
    """A single environment that tells the simulator's state."""

    def scene(self) -> SceneState:
        """The state now."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class LabelledFrames:
    """Frames of whole episodes, in order; every frame but an episode's last is followed by the next one."""

    rgb: UInt8[np.ndarray, "frames height width 3"]
    proprio: Float32[np.ndarray, "frames proprio"]
    goal: Float32[np.ndarray, "frames 3"]
    """The goal's projection, as in `Observation`."""
    uv: Float32[np.ndarray, "frames objects 2"]
    visible: Bool[np.ndarray, "frames objects"]
    contact: Bool[np.ndarray, " frames"]
    """A finger touches the first object while the picture is taken."""
    distance_m: Float32[np.ndarray, " frames"]
    """From the tool centre point to the first object's centre."""
    object_m: Float32[np.ndarray, "frames 3"]
    """The first object's centre in the world."""
    episode: Int32[np.ndarray, " frames"]
    """Seed of the frame's episode."""
    step: Int32[np.ndarray, " frames"]
    """Steps since the episode's reset."""

    @property
    def has_next(self) -> Bool[np.ndarray, " frames"]:
        """Whether the following frame belongs to the same episode."""
        return np.append(self.episode[1:] == self.episode[:-1], False) if len(self.episode) else np.zeros(0, bool)


def collect_frames(
    env: SceneEnv, policy: Policy, seeds: Sequence[int], num_steps: int
) -> Iterator[dict[str, np.ndarray]]:
    """Play an episode for each seed and give its frames as columns; `join_frames` puts episodes together.

    An episode's last picture is left out: the environment has reset itself by the time its state could be read.

    Args:
        env: a single environment with a camera.
        policy: who acts.
        seeds: of the episodes.
        num_steps: frames of an episode at most.
    """
    for seed in seeds:
        observation = env.reset([seed])
        if observation.rgb is None:
            raise ValueError("frames need a camera: build the environment with camera=True")
        rows: list[dict[str, Any]] = []
        for step in range(num_steps):
            scene = env.scene()
            centre = scene.object_poses[0, 0, :3].cpu().numpy()
            assert observation.rgb is not None
            rows.append(
                {
                    "rgb": observation.rgb[0],
                    "proprio": observation.proprio[0],
                    "goal": observation.goal[0],
                    "uv": observation.uv[0],
                    "visible": observation.visible[0],
                    "contact": bool(scene.contact[0]),
                    "distance_m": np.linalg.norm(scene.tcp_pose[0, :3].cpu().numpy() - centre).astype(np.float32),
                    "object_m": centre.astype(np.float32),
                    "episode": np.int32(seed),
                    "step": np.int32(step),
                }
            )
            if step + 1 == num_steps:
                break
            result = env.step(policy.act(observation, policy.visual(observation)), [seed])
            if result.terminated[0] or result.truncated[0]:
                break
            observation = result.observation
        yield {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def join_frames(episodes: Sequence[dict[str, np.ndarray]]) -> LabelledFrames:
    """The episodes one after another; raises ``ValueError`` without any."""
    if not episodes:
        raise ValueError("there are no episodes: ask for 1 or more")
    return LabelledFrames(**{name: np.concatenate([e[name] for e in episodes]) for name in episodes[0]})


def save_frames(frames: LabelledFrames, path: Path) -> None:
    """Write the frames as one compressed file that is whole or not there."""
    packed = io.BytesIO()
    columns = {f.name: getattr(frames, f.name) for f in dataclasses.fields(frames)}
    np.savez_compressed(packed, **cast(Any, columns))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, [packed.getbuffer()])


def load_frames(path: Path) -> LabelledFrames:
    """Read frames back; raises ``ValueError`` naming the file if it is damaged."""
    try:
        with np.load(path, allow_pickle=False) as packed:
            return LabelledFrames(**{f.name: packed[f.name] for f in dataclasses.fields(LabelledFrames)})
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: damaged ({error}); delete it, and it will be collected again") from None
