"""Feeds corrupt input to one reader of files, in a process that may take little memory; `test_fuzzing` starts it.

    python fuzzing.py READER FOLDER EXAMPLES

Files are corrupted as they rot (flipped bits, cuts) and as somebody would forge them: with sizes, types and nesting of
all kinds under checksums that are right. For each, a reader must give a value or one plain `ValueError`.
"""

import copy
import hashlib
import json
import resource
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from corruption import (
    Random,
    forged,
    json_text,
    number_nested,
    refilled,
    rot_a_file,
    rotten,
    strange_array,
    strange_value,
    write_json,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from slotfilm_dist.atomic import file_digest
from slotfilm_dist.config_files import load_config, save_config, to_dict
from slotfilm_dist.messages import TransitionBlock
from slotfilm_dist.presets import smoke
from slotfilm_dist.replay.codec import decode, encode
from slotfilm_dist.replay.dataset import open_dataset
from slotfilm_dist.replay.dataset_writer import FrameDatasetWriter
from slotfilm_dist.replay.schema import ReplaySchema
from slotfilm_dist.replay.shard import ReplayShard
from slotfilm_dist.replay.snapshot import MANIFEST, read_snapshot, write_snapshot
from slotfilm_dist.variants import apply_variant

SPARE_BYTES = 1 << 28
"""Address space that a reader may take beyond what the process holds when the fuzzing begins."""
CAPACITY = 8000

Corruption = Callable[[Random], object]

outcomes = {"read": 0, "refused": 0}


def main(reader: str, folder: str, examples: str) -> None:
    corruptions = READERS[reader](Path(folder))
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines() if ":" in line)
    limit = int(status["VmSize"].split()[0]) * 1024 + SPARE_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    rules = settings(
        max_examples=int(examples) // len(corruptions),
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )
    for corrupt_and_read in corruptions:
        rules(given(st.randoms(use_true_random=False), st.just(corrupt_and_read))(apply))()
    print(json.dumps(outcomes))


def apply(rng: Random, corrupt_and_read: Corruption) -> None:
    corrupt_and_read(rng)


def expect_value_or_refusal(read: Callable[[], object], mention: object = "") -> None:
    error = refusal_of(read)
    outcomes["read" if error is None else "refused"] += 1
    if error is not None:
        assert type(error) is ValueError, f"callers expect a plain ValueError, not {error!r:.300}"
        assert str(error), "a refusal must say why"
        assert str(mention) in str(error), f"{error!s:.300} does not name the file"


def refusal_of(read: Callable[[], object]) -> ValueError | None:
    try:
        read()
    except ValueError as error:
        return error
    return None


def make_block(first_step: int, num_steps: int, schema: ReplaySchema, sequence: int) -> TransitionBlock:
    rows, rng = num_steps + 1, np.random.default_rng(first_step)
    kind = np.float16 if schema.visual_kind == "tokens" else np.uint8
    flags = np.arange(rows) < num_steps
    return TransitionBlock(
        worker_id=0,
        incarnation=0,
        sequence=sequence,
        policy_version=3,
        backbone_hash=schema.backbone_hash,
        visual=rng.integers(0, 200, (rows, *schema.visual_shape)).astype(kind),
        proprio=rng.random((rows, 3), np.float32),
        goal=rng.random((rows, 3), np.float32),
        uv=rng.random((rows, 2, 2), np.float32),
        visible=np.ones((rows, 2), bool),
        action=rng.random((rows, 2), np.float32),
        reward=rng.random(rows, np.float32),
        terminated=np.zeros(rows, bool),
        truncated=np.zeros(rows, bool),
        is_step=flags,
    )


def codec(folder: Path) -> list[Corruption]:
    """The msgpack reader on bytes."""
    state = {"a": [1, -2.5, None, True, "word", b"bytes"], "b": {"c": np.arange(40.0).reshape(5, 8)}, "d": [[[[0]]]]}
    good = encode(state)
    heads = [bytes([tag]) + size for tag in range(0xC0, 0xE0) for size in (b"\xff" * 9, b"\x7f" * 9, bytes(9))]

    def bomb(rng: Random) -> bytes:
        return rng.choice(
            [rng.choice(heads) * rng.randrange(1, 200), b"\x91" * 100_000, b"\xdd\x00\xff\xff\xff" * 9999]
        )

    def cut_in(rng: Random) -> bytes:
        at = rng.randrange(len(good))
        return good[:at] + bomb(rng)[: rng.randrange(1, 4000)] + good[at:]

    makers = (lambda rng: rotten(good, rng), lambda rng: rotten(rotten(good, rng), rng), bomb, cut_in)
    return [lambda rng, make=make: expect_value_or_refusal(lambda: decode(make(rng)), "not a valid") for make in makers]


def snapshot(folder: Path) -> list[Corruption]:
    """Replay's snapshots, and a shard that takes one over and draws from it."""
    schema = ReplaySchema(
        visual_kind="tokens", visual_shape=(4, 4), proprio_dim=3, action_dim=2, num_objects=2, backbone_hash="b"
    )
    shard = ReplayShard(schema, CAPACITY, 1)
    for sequence in range(15):
        shard.insert(make_block(500 * sequence, 500, schema, sequence))
    base, changed = folder / "base", folder / "changed"
    write_snapshot(base, shard.view())
    good = json.loads((base / MANIFEST).read_text())["manifest"]
    rest = next(base.glob("*.msgpack"))
    state = decode(rest.read_bytes())

    def use() -> None:
        other = ReplayShard(schema, CAPACITY, 2)
        other.load(read_snapshot(changed))
        other.draw([8])

    def sign(manifest: Any) -> None:
        signature = hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
        (changed / MANIFEST).write_text(json.dumps({"manifest": manifest, "sha256": signature}))

    def rot(rng: Random) -> None:
        rot_a_file(base, changed, rng)
        expect_value_or_refusal(use, changed)

    def forge_manifest(rng: Random) -> None:
        refilled(base, changed)
        try:
            sign(forged(good, rng))
        except RecursionError:
            return
        expect_value_or_refusal(use)

    def forge_state(rng: Random, *, raw: bool = False) -> None:
        refilled(base, changed)
        leaf = strange_array if rng.random() < 0.5 else strange_value
        try:
            content = rotten(rest.read_bytes(), rng) if raw else encode(forged(state, rng, leaf))
        except ValueError:
            return  # our own writer refuses it already
        (changed / rest.name).write_bytes(content)
        sign({**good, "files": {**good["files"], rest.name: to_dict(file_digest(changed / rest.name))}})
        expect_value_or_refusal(use)

    def forge_array(rng: Random) -> None:
        path = rng.choice(sorted(refilled(base, changed).glob("*.bin")))
        path.write_bytes(rotten(path.read_bytes(), rng))
        manifest = copy.deepcopy(good)
        manifest["files"][path.name] = to_dict(file_digest(path))
        sign(manifest)
        expect_value_or_refusal(use)

    return [rot, forge_manifest, forge_state, lambda rng: forge_state(rng, raw=True), forge_array]


def dataset(folder: Path) -> list[Corruption]:
    """The random policy's data, and the blocks that are made of them; an unfinished one, and going on with it."""
    schema = ReplaySchema(
        visual_kind="rgb", visual_shape=(4, 4, 3), proprio_dim=3, action_dim=2, num_objects=2, store_labels=True
    )
    base, changed, begun = folder / "base", folder / "changed", folder / "begun"
    for path in (base, begun):
        with FrameDatasetWriter(path, schema, "hash", commit_rows=8) as writer:
            for sequence in range(3):
                writer.append(make_block(12 * sequence, 12, schema, sequence))
            if path == base:
                writer.finish()
    good = json.loads((base / "manifest.json").read_text())
    progress = json.loads((begun / "progress.json").read_text())

    def use() -> None:
        data = open_dataset(changed, "hash")
        assert sum(block.num_steps for block in data.blocks(16)) == data.num_steps

    def rot(rng: Random) -> None:
        rot_a_file(base, changed, rng)
        expect_value_or_refusal(use, changed)

    def forge_manifest(rng: Random) -> None:
        refilled(base, changed)
        write_json(changed / "manifest.json", forged(good, rng))
        expect_value_or_refusal(use, changed)

    def forge_column(rng: Random) -> None:
        path = rng.choice(sorted(refilled(base, changed).glob("*.npy")))
        content = path.read_bytes()
        cut = rng.choice([16, 128, len(content)])
        path.write_bytes(rng.choice([rotten(content[:cut], rng), b"PK\x03\x04" + content]) + content[cut:])
        files = {**good["files"], path.name: to_dict(file_digest(path))}
        write_json(changed / "manifest.json", {**good, "files": files})
        expect_value_or_refusal(use, changed)

    def forge_progress(rng: Random) -> None:
        refilled(begun, changed)
        write_json(changed / "progress.json", forged(progress, rng))
        expect_value_or_refusal(lambda: FrameDatasetWriter(changed, schema, "hash").close(), changed)

    return [rot, forge_manifest, forge_column, forge_progress]


def checkpoint(folder: Path) -> list[Corruption]:
    """A learner's checkpoints, and a learner that takes one over; the config beside them."""
    import torch

    from slotfilm_dist.learning.checkpoint import (
        TENSORS,
        read_checkpoint,
        write_checkpoint,
    )
    from slotfilm_dist.learning.learner import Learner

    torch.set_num_threads(1)
    config = apply_variant("state_only", smoke())
    learner = Learner(config, 7, torch.device("cpu"))
    learner.begin_rl(None)
    learner.rl.updates = 1
    base, changed = folder / "base", folder / "changed"
    state = learner.checkpoint({"limiter": {"env_steps": 400}, "rollout": [1, 2]})
    write_checkpoint(base, state)
    good = {k: v for k, v in json.loads((base / "manifest.json").read_text()).items() if k != "sha256"}
    content = (base / TENSORS).read_bytes()
    head_bytes = int.from_bytes(content[:8], "little")
    head = json.loads(content[8 : 8 + head_bytes])
    save_config(config, folder / "config.json")
    settings_text = (folder / "config.json").read_text()

    def use() -> None:
        learner.load_checkpoint(read_checkpoint(changed))

    def sign(manifest: Mapping[str, Any]) -> None:
        signature = hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
        write_json(changed / "manifest.json", {**manifest, "sha256": signature})

    def rot(rng: Random) -> None:
        rot_a_file(base, changed, rng)
        expect_value_or_refusal(use, changed)

    def forge_manifest(rng: Random) -> None:
        refilled(base, changed)
        manifest = forged(good, rng)
        try:
            sign(manifest) if isinstance(manifest, dict) else write_json(changed / "manifest.json", manifest)
        except RecursionError:
            return
        expect_value_or_refusal(use)

    def forge_tensors(rng: Random) -> None:
        refilled(base, changed)
        text = json_text(forged(head, rng)) if rng.random() < 0.7 else rotten(content[8 : 8 + head_bytes], rng)
        size = len(text) if rng.random() < 0.8 else rng.choice([0, 2**20, 2**40, 2**63, 2**64 - 1])
        (changed / TENSORS).write_bytes(size.to_bytes(8, "little") + text + content[8 + head_bytes :])
        sign({**good, "tensors": to_dict(file_digest(changed / TENSORS))})
        expect_value_or_refusal(use)

    def forge_weights(rng: Random) -> None:
        tensors = dict(state.tensors)
        name = rng.choice(sorted(tensors))
        tensors[name] = torch.from_numpy(np.atleast_1d(strange_array(rng)))
        if rng.random() < 0.3:
            tensors[rng.choice(["critic_optimiser.0.x", "actor.x", "optimiser.999999999.step", name + ".0"])] = tensors[
                name
            ]
        if rng.random() < 0.3:
            del tensors[rng.choice(sorted(tensors))]
        values = forged(state.values, rng) if rng.random() < 0.3 else state.values
        broken = type(state)(tensors=tensors, values=values if isinstance(values, dict) else {}, config_hash="x")
        expect_value_or_refusal(lambda: learner.load_checkpoint(broken))

    def forge_config(rng: Random) -> None:
        text = json_text(forged(json.loads(settings_text), rng)).decode()
        path = folder / "config.json"
        path.write_text(number_nested(text, rng) if rng.random() < 0.2 else text)
        expect_value_or_refusal(lambda: load_config(path), path)

    return [rot, forge_manifest, forge_tensors, forge_weights, forge_config]


READERS = {reader.__name__: reader for reader in (codec, snapshot, dataset, checkpoint)}

if __name__ == "__main__":
    main(*sys.argv[1:])
