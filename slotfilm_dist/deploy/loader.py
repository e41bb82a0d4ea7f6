"""Loads an exported policy and acts with it: on a robot, in a notebook, without the simulator, Ray or a run.

    from slotfilm_dist.deploy.loader import load_policy

    policy = load_policy(Path("runs/mine/export"))                    # or backend="onnx", which needs no torch
    action = policy.act(rgb=picture, proprio=state)                   # float32 in [-1, 1], one observation at a time

`policy.inputs` names the arrays that `act` wants. Pictures are uint8 RGB and the state is in its own units: what either
is normalised with lies inside the model (and, to read, in `policy.json`).
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, Shaped

from slotfilm_dist.atomic import FileDigest, check_file
from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import from_dict

MANIFEST = "policy.json"
FORMAT = 1
"""Version of the layout on disk."""
BackendName = Literal["torch", "onnx"]
FILES: dict[BackendName, str] = {"torch": "policy.pt2", "onnx": "policy.onnx"}

_DTYPES = ("uint8", "float32")
_Run = Callable[[Mapping[str, np.ndarray]], np.ndarray]


@dataclass(frozen=True, kw_only=True, slots=True)
class PolicyInput:
    """One array that the policy reads."""

    shape: tuple[int, ...]
    """Without a batch axis."""
    dtype: str
    """`uint8` or `float32`."""


class DeployedPolicy:
    """The most likely action of a trained agent.

    Args:
        manifest: what `policy.json` says.
        inputs: arrays that `act` wants, by name.
        run: computes [1, action] from arrays with a batch axis of 1.
    """

    def __init__(self, manifest: Mapping[str, Any], inputs: Mapping[str, PolicyInput], run: _Run) -> None:
        self.manifest = manifest
        self.inputs = inputs
        self._run = run

    def act(self, **observation: Shaped[np.ndarray, "..."]) -> Float32[np.ndarray, " action"]:
        """The action for one observation, in [-1, 1].

        Args:
            observation: an array for each of `inputs`: `rgb` [height, width, 3] uint8; `proprio` [state] float32, the
                fields of `policy.json`'s `state_fields` in order; `goal` [3] float32: its projection u, v in image
                units and 1 if in view, else 0.

        Raises:
            ValueError: an array is missing, unknown, or of another shape or type, or the action is not finite.
        """
        if odd := sorted(observation.keys() ^ self.inputs.keys()):
            raise ValueError(f"observation: {odd[0]!r} is missing or unknown; give {', '.join(self.inputs)}")
        batch: dict[str, np.ndarray] = {}
        for name, wanted in self.inputs.items():
            array = np.asarray(observation[name])
            if array.shape != wanted.shape or array.dtype != wanted.dtype:
                raise ValueError(
                    f"observation: {name} is {array.dtype} {array.shape}, must be {wanted.dtype} {wanted.shape}"
                )
            batch[name] = np.ascontiguousarray(array[None])
        action = self._run(batch)[0]
        if not np.isfinite(action).all():
            raise ValueError("the action is not finite; is an input not finite?")
        return action


def load_policy(directory: Path, backend: BackendName = "torch") -> DeployedPolicy:
    """Load what `slotfilm export` wrote.

    Args:
        directory: where it wrote it.
        backend: `torch`, or `onnx`, which needs onnxruntime and no torch.

    Raises:
        ValueError: a file is missing, altered, or of another format; names the file.
    """
    manifest, inputs, digests = _read_manifest(directory / MANIFEST)
    if backend not in digests:
        raise ValueError(f"{directory} holds no {backend} policy; export it again with --format {backend} or both")
    path = directory / FILES[backend]
    check_file(path, digests[backend])
    run = _load_torch(path) if backend == "torch" else _load_onnx(path)
    return DeployedPolicy(manifest, inputs, run)


def _read_manifest(path: Path) -> tuple[dict[str, Any], dict[str, PolicyInput], dict[BackendName, FileDigest]]:
    try:
        manifest = json.loads(path.read_bytes())
        if manifest["format"] != FORMAT:
            raise ValueError(f"its format is {manifest['format']!r}, this version reads {FORMAT}")
        from_dict(RunConfig, manifest["config"])
        inputs = {
            name: PolicyInput(shape=tuple(i["shape"]), dtype=i["dtype"]) for name, i in manifest["inputs"].items()
        }
        if not inputs or any(i.dtype not in _DTYPES for i in inputs.values()):
            raise ValueError(f"inputs must be of type {' or '.join(_DTYPES)}")
        digests: dict[BackendName, FileDigest] = {
            name: FileDigest(num_bytes=manifest["files"][name]["num_bytes"], sha256=manifest["files"][name]["sha256"])
            for name in FILES
            if name in manifest["files"]
        }
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist: {path.parent} is no exported policy; see `slotfilm export`") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path} is damaged ({error}); export the policy again") from None
    return manifest, inputs, digests


def _load_torch(path: Path) -> _Run:
    import torch

    from slotfilm_dist.deploy.archive import check_archive

    check_archive(path)
    model = torch.export.load(path).module()

    @torch.inference_mode()
    def run(batch: Mapping[str, np.ndarray]) -> np.ndarray:
        action: torch.Tensor = model(*map(torch.from_numpy, batch.values()))
        return action.numpy()

    return run


def _load_onnx(path: Path) -> _Run:
    try:
        import onnxruntime
    except ImportError:
        raise ValueError(f"{path} needs onnxruntime: pip install 'slotfilm-dist[export]'") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # one picture is too little work to share
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])

    def run(batch: Mapping[str, np.ndarray]) -> np.ndarray:
        return np.asarray(session.run(None, dict(batch))[0])

    return run
