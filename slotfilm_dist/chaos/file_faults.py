"""Damaged files, wrong commands and things that are missing. None of these needs a run under way."""

import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from slotfilm_dist.chaos.live import live_config
from slotfilm_dist.chaos.outcome import Observation
from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.toy import ACTION_DIM
from slotfilm_dist.learning.checkpoint import MANIFEST, TENSORS, CheckpointStore, read_checkpoint
from slotfilm_dist.learning.learner import Learner, learning_hash

FLIPS = 500
REFUSED = 2
TYPO_S, RESOURCES_S, ASSET_S = 2.0, 10.0, 5.0


def flipped_bits(folder: Path, rng: np.random.Generator) -> Observation:
    """Single bits of the newest checkpoint, and the file cut short."""
    config = live_config(0)
    store = _two_checkpoints(folder / "flipped", config)
    newest = store.folder / "updates-000000002"
    loaded, detected, fell_back = 0, 0, 0
    for _ in range(FLIPS):
        path = newest / (TENSORS if rng.random() < 0.5 else MANIFEST)
        good = path.read_bytes()
        bad = bytearray(good)
        bad[rng.integers(len(bad))] ^= 1 << int(rng.integers(8))
        path.write_bytes(bad)
        found = store.read_last(learning_hash(config))
        assert found is not None, "two checkpoints are there"
        detected += bool(found[1])
        loaded += not found[1]
        fell_back += found[0].values["updates"] == 1
        path.write_bytes(good)
    (newest / TENSORS).write_bytes((newest / TENSORS).read_bytes()[:-1])
    found = store.read_last(learning_hash(config))
    cut = found is not None and str(newest / TENSORS) in found[1][0]
    return Observation(
        observed="every one was noticed, the file was named, the checkpoint before was used",
        figure=f"{detected} of {FLIPS} flips detected, {fell_back} fell back, {loaded} loaded silently; cut file named "
        f"{cut}",
        holds=detected == fell_back == FLIPS and cut,
    )


def malicious_pickle(folder: Path, rng: np.random.Generator) -> Observation:
    """A pickle that runs a command, in place of the tensors and of the manifest, with and without its right hash."""
    config = live_config(0)
    store = _two_checkpoints(folder / "pickle", config)
    witness = folder / "executed"
    code = f"cposix\nsystem\n(S'touch {witness}'\ntR.".encode()
    refused = 0
    for name in (TENSORS, MANIFEST):
        path = store.folder / "updates-000000002" / name
        good = path.read_bytes()
        path.write_bytes(code)
        found = store.read_last(learning_hash(config))
        refused += found is not None and bool(found[1])
        path.write_bytes(good)
    (store.folder / "model.pt").write_bytes(code)
    try:
        read_checkpoint(store.folder / "model.pt")
    except (ValueError, NotADirectoryError):
        refused += 1
    return Observation(
        observed="refused before anything was unpickled",
        figure=f"{refused} of 3 refused; code executed {int(witness.exists())} times",
        holds=refused == 3 and not witness.exists(),
    )


def other_config(folder: Path, rng: np.random.Generator) -> Observation:
    """A checkpoint of another seed, and one of a network of another size."""
    config = live_config(0)
    store = _two_checkpoints(folder / "other", config)
    said: list[str] = []
    wider = replace(config, sac=replace(config.sac, hidden=(128, 256)))
    for reader in (replace(config, seed=1), wider):
        try:
            store.read_last(learning_hash(reader))
        except ValueError as error:
            said.append(str(error))
    found = store.read_last(learning_hash(config))
    try:
        Learner(wider, ACTION_DIM, torch.device("cpu")).load_checkpoint(found[0])  # type: ignore[index]  # it is there
    except ValueError as error:
        said.append(str(error))
    hashes = sum("was written by a run with config" in text for text in said)
    shapes = sum("has shape" in text for text in said)
    return Observation(
        observed="refused, with both configs' hashes; with the hash ignored, both shapes are named",
        figure=f"{hashes} of 2 refused by hash, {shapes} of 1 by shape",
        holds=hashes == 2 and shapes == 1,
    )


def wrong_setting(folder: Path, rng: np.random.Generator) -> Observation:
    """A misspelt field, an impossible value."""
    typo = _Command("train", "smoke", "--runs", str(folder), "--sac.temprature", "0.2")
    value = _Command("train", "smoke", "--runs", str(folder), "--sac.gamma", "1.5")
    named = "did you mean --sac.temperature" in typo.said and "sac.gamma" in value.said
    return Observation(
        observed="refused before anything was started, with the nearest field",
        figure=f"exit codes {typo.code}, {value.code} in {typo.took_s:.1f}, {value.took_s:.1f} s (at most {TYPO_S:g})",
        holds=named and typo.code == value.code == REFUSED and max(typo.took_s, value.took_s) <= TYPO_S,
    )


def missing_gpu(folder: Path, rng: np.random.Generator) -> Observation:
    """A GPU asked for where there is none."""
    if torch.cuda.is_available():
        return Observation(observed="this machine has a GPU", figure="not applicable", holds=True)
    tried = _Command(
        *("train", "smoke", "--runs", str(folder), "--name", "gpu", "--variant", "state_only"),
        *("--runtime.mode", "local", "--runtime.device", "cuda"),
    )
    return Observation(
        observed="refused with the cause and `--runtime.device cpu`",
        figure=f"exit code {tried.code} after {tried.took_s:.1f} s (at most {RESOURCES_S:g})",
        holds="--runtime.device cpu" in tried.said and tried.code == REFUSED and tried.took_s <= RESOURCES_S,
    )


def missing_weights(folder: Path, rng: np.random.Generator) -> Observation:
    """A backbone file that is not there."""
    tried = _Command(
        *("train", "smoke", "--runs", str(folder), "--name", "weights", "--runtime.mode", "local"),
        *("--encoder.backbone", "path", "--encoder.backbone_path", str(folder / "nothing.safetensors")),
    )
    return Observation(
        observed="refused; the file is named",
        figure=f"exit code {tried.code} after {tried.took_s:.1f} s (at most {ASSET_S:g})",
        holds=tried.code == REFUSED and "nothing.safetensors" in tried.said and tried.took_s <= ASSET_S,
    )


class _Command:
    """Runs `slotfilm` with these words; gives exit code, last line and time."""

    def __init__(self, *words: str) -> None:
        began = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-m", "slotfilm_dist", *words], capture_output=True, text=True, timeout=120
        )
        self.took_s, self.code, self.said = time.monotonic() - began, done.returncode, done.stderr.strip()


def _two_checkpoints(folder: Path, config: RunConfig) -> CheckpointStore:
    """A real learner's checkpoints, one update and two updates old."""
    learner = Learner(config, ACTION_DIM, torch.device("cpu"))
    learner.begin_rl(None)
    store = CheckpointStore(folder, 2)
    for updates in (1, 2):
        learner.rl.updates = updates
        store.write(learner.checkpoint({}), updates)
    return store
