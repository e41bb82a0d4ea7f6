"""Checkpoints on disk: exact, whole or refused, and the newest that can be read."""

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
import torch

from slotfilm_dist.learning.checkpoint import (
    MANIFEST,
    TENSORS,
    Checkpoint,
    CheckpointStore,
    plain_tensors,
    read_checkpoint,
    write_checkpoint,
)


def checkpoint(number: int = 1, config_hash: str = "abc") -> Checkpoint:
    tensors = {
        "weights": torch.arange(12, dtype=torch.float32).view(3, 4) * number,
        "half": torch.full((2,), 0.1, dtype=torch.float16),
        "noise": torch.arange(200, dtype=torch.uint8),
        "scalar": torch.tensor(float(number)),
    }
    return Checkpoint(tensors=tensors, values={"updates": number, "nested": {"big": 2**100}}, config_hash=config_hash)


def read_or_refusal(folder: Path) -> Checkpoint | str:
    try:
        return read_checkpoint(folder)
    except ValueError as error:
        return str(error)


def flip_bit(path: Path, position: int) -> None:
    content = bytearray(path.read_bytes())
    content[position] ^= 1
    path.write_bytes(content)


def test_round_trip_is_exact(tmp_path: Path) -> None:
    written = checkpoint()
    size = write_checkpoint(tmp_path / "c", written)
    found = read_checkpoint(tmp_path / "c", "abc")
    assert size == (tmp_path / "c" / TENSORS).stat().st_size
    assert found.values == written.values
    assert found.tensors.keys() == written.tensors.keys()
    for name, value in written.tensors.items():
        assert found.tensors[name].dtype == value.dtype
        assert torch.equal(found.tensors[name], value)


@pytest.mark.parametrize("name", [TENSORS, MANIFEST])
def test_a_flipped_bit_anywhere_is_refused_and_the_file_named(tmp_path: Path, name: str) -> None:
    write_checkpoint(tmp_path / "c", checkpoint())
    path = tmp_path / "c" / name
    original = path.read_bytes()
    values = json.loads((tmp_path / "c" / MANIFEST).read_text())
    for position in range(0, len(original), 7):
        flip_bit(path, position)
        found = read_or_refusal(tmp_path / "c")
        if isinstance(found, str):
            assert str(tmp_path / "c") in found
        else:
            # Only layout, or the name of the signature itself, may change unnoticed.
            assert found.values == values["values"]
            assert found.config_hash == values["config_hash"]
            assert all(torch.equal(found.tensors[k], v) for k, v in checkpoint().tensors.items())
        path.write_bytes(original)


def test_an_altered_counter_is_refused(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "c", checkpoint())
    path = tmp_path / "c" / MANIFEST
    path.write_text(path.read_text().replace('"updates": 1', '"updates": 3'))
    with pytest.raises(ValueError, match=r"manifest\.json: damaged, its SHA-256 differs"):
        read_checkpoint(tmp_path / "c")


@pytest.mark.parametrize("name", [TENSORS, MANIFEST])
def test_a_file_cut_short_is_refused(tmp_path: Path, name: str) -> None:
    write_checkpoint(tmp_path / "c", checkpoint())
    path = tmp_path / "c" / name
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(ValueError, match=name.replace(".", r"\.")):
        read_checkpoint(tmp_path / "c")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 99}, "written in format 99"),
        ({"tensors": None}, "damaged"),
        ({"tensors": {"num_bytes": 3}}, "damaged"),
    ],
)
def test_a_manifest_of_another_make_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    write_checkpoint(tmp_path / "c", checkpoint())
    path = tmp_path / "c" / MANIFEST
    manifest = json.loads(path.read_text())
    del manifest["sha256"]
    changed = manifest | change
    signature = hashlib.sha256(json.dumps(changed, sort_keys=True).encode()).hexdigest()
    path.write_text(json.dumps(changed | {"sha256": signature}))
    with pytest.raises(ValueError, match=message):
        read_checkpoint(tmp_path / "c")


def test_a_manifest_without_its_hash_is_refused(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "c", checkpoint())
    path = tmp_path / "c" / MANIFEST
    path.write_text(path.read_text().replace('"sha256": ', '"sha257": '))
    with pytest.raises(ValueError, match=r"manifest\.json: damaged"):
        read_checkpoint(tmp_path / "c")


def test_strict_reading_names_the_damage_instead_of_going_back(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path, keep=2)
    store.write(checkpoint(), 1)
    store.write(checkpoint(), 2)
    damaged = tmp_path / "updates-000000002" / TENSORS
    damaged.write_bytes(damaged.read_bytes()[:-1])
    found = store.read_last("abc")
    assert found is not None
    assert str(damaged) in found[1][0]
    with pytest.raises(ValueError, match=r"cut short or altered; --checkpoint\.no_strict"):
        store.read_last("abc", strict=True)


def test_another_config_and_a_missing_checkpoint_are_refused(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "c", checkpoint())
    with pytest.raises(ValueError, match="written by a run with config abc, this one is other"):
        read_checkpoint(tmp_path / "c", "other")
    with pytest.raises(ValueError, match="is no checkpoint"):
        read_checkpoint(tmp_path / "nothing")


def test_failed_write_leaves_the_older_checkpoint(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "c", checkpoint(1))
    unwritable = Checkpoint(tensors={}, values={"a": object()}, config_hash="abc")
    with pytest.raises(TypeError):
        write_checkpoint(tmp_path / "c", unwritable)
    assert read_checkpoint(tmp_path / "c").values["updates"] == 1
    assert [path.name for path in tmp_path.iterdir()] == ["c"]


def test_store_keeps_the_last_few_and_the_best(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path, keep=2)
    for number in (5, 10, 100):
        store.write(checkpoint(number), number)
    store.write_best(checkpoint(10))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["best", "updates-000000010", "updates-000000100"]
    found = store.read_last("abc")
    assert found is not None
    assert (found[0].values["updates"], found[1]) == (100, [])


def test_store_falls_back_to_an_older_checkpoint_and_says_why(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path, keep=3)
    for number in (1, 2):
        store.write(checkpoint(number), number)
    flip_bit(tmp_path / "updates-000000002" / TENSORS, 100)
    found = store.read_last("abc")
    assert found is not None
    assert found[0].values["updates"] == 1
    assert len(found[1]) == 1
    assert "updates-000000002" in found[1][0]


def test_checkpoint_just_written_stays_and_those_that_the_run_went_back_behind_go(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path, keep=1)
    for number in (10, 20):
        store.write(checkpoint(number), number)
    flip_bit(tmp_path / "updates-000000020" / TENSORS, 100)
    store.write(checkpoint(12), 12)
    assert [path.name for path in tmp_path.iterdir()] == ["updates-000000012"]
    found = store.read_last("abc")
    assert found is not None
    assert (found[0].values["updates"], found[1]) == (12, [])


def test_store_without_checkpoints_gives_none_and_with_bad_ones_refuses(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path / "checkpoints", keep=2)
    assert store.read_last("abc") is None
    store.write(checkpoint(1), 1)
    with pytest.raises(ValueError, match=r"no checkpoint can be used: .*updates-000000001"):
        store.read_last("other")


def test_a_checkpoint_whose_replacement_was_interrupted_is_found(tmp_path: Path) -> None:
    store = CheckpointStore(tmp_path, keep=2)
    store.write(checkpoint(7), 7)
    (tmp_path / "updates-000000007").rename(tmp_path / "updates-000000007.retired")
    found = store.read_last("abc")
    assert found is not None
    assert found[0].values["updates"] == 7


def test_plain_tensors_are_copies_without_gradient() -> None:
    parameter = torch.nn.Parameter(torch.zeros(2, 3))
    copies = plain_tensors({"a": parameter, "b": parameter.T})
    with torch.no_grad():
        parameter.add_(1)
    assert copies["a"].sum() == 0
    assert not copies["a"].requires_grad
    assert copies["b"].is_contiguous()
