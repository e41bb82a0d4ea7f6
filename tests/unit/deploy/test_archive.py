"""A forged archive is refused before torch reads it."""

import json
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from slotfilm_dist.deploy.archive import check_archive

GRAPH, WEIGHTS = "models/model.json", "data/weights/model_weights_config.json"


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    program = torch.export.export(torch.nn.Linear(3, 2), (torch.zeros(1, 3),))
    program.example_inputs = None
    path = tmp_path_factory.mktemp("archive") / "policy.pt2"
    torch.export.save(program, path)
    return path


def rewritten(archive: Path, out: Path, changes: dict[str, Callable[[bytes], bytes | None]]) -> Path:
    """A copy with members changed, added or, where a change gives None, left out."""
    with zipfile.ZipFile(archive) as old, zipfile.ZipFile(out, "w") as new:
        top = old.namelist()[0].split("/")[0]
        for name in dict.fromkeys([*old.namelist(), *(f"{top}/{member}" for member in changes)]):
            member = name.partition("/")[2]
            content = old.read(name) if name in old.namelist() else b""
            content = changes[member](content) if member in changes else content
            if content is not None:
                new.writestr(name, content)
    return out


def edit(change: Callable[[Any], None]) -> Callable[[bytes], bytes]:
    def apply(content: bytes) -> bytes:
        value = json.loads(content)
        change(value)
        return json.dumps(value).encode()

    return apply


def nodes(model: Any) -> Any:
    return model["graph_module"]["graph"]["nodes"]


class Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return print, ("code of the archive ran",)


def first(config: Any) -> Any:
    return next(iter(config["config"].values()))


def test_archive_as_exported_passes(archive: Path) -> None:
    check_archive(archive)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"data/sample_inputs/model.pt": lambda c: pickle.dumps(Evil())}, "may be pickled"),
        ({"data/constants/opaque_obj_0": lambda c: pickle.dumps(Evil())}, "may be pickled"),
        ({"data/weights/model.pt": lambda c: pickle.dumps(Evil())}, "may be pickled"),
        ({"../../outside": lambda c: b""}, "not needed"),
        ({WEIGHTS: edit(lambda c: first(c).update(use_pickle=True))}, "is pickled"),
        ({WEIGHTS: edit(lambda c: first(c).update(path_name="../x"))}, "lies in"),
        ({GRAPH: edit(lambda m: nodes(m)[0].update(target="torch.hub.load"))}, "calls 'torch.hub.load'"),
        ({GRAPH: edit(lambda m: nodes(m)[0].update(target="_operator.call"))}, "calls"),
        ({GRAPH: edit(lambda m: m.update(guards_code=["print('ran')"]))}, "conditions on sizes"),
        ({GRAPH: edit(lambda m: m.update(range_constraints={"s0": {}}))}, "conditions on sizes"),
        ({GRAPH: edit(lambda m: nodes(m)[0]["inputs"][0].update(arg={"as_expr": {"expr_str": "f()"}}))}, "as_expr"),
        ({GRAPH: edit(lambda m: nodes(m)[0]["outputs"][0]["as_tensor"].update(name="x; print()"))}, "the name"),
        ({GRAPH: lambda c: b"[" * 100_000}, "no archive"),
        ({GRAPH: lambda c: b"{}"}, "no archive"),
        ({GRAPH: lambda c: None}, r"no models/model\.json"),
    ],
)
def test_forged_archive_is_refused(
    archive: Path, tmp_path: Path, changes: dict[str, Callable[[bytes], bytes | None]], complaint: str
) -> None:
    forged = rewritten(archive, tmp_path / "forged.pt2", changes)
    with pytest.raises(ValueError, match=rf"forged\.pt2 is no archive .*{complaint}|forged\.pt2 is {complaint}"):
        check_archive(forged)


def test_what_is_no_archive_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.pt2").write_bytes(b"PK\x03\x04 but no more")
    with pytest.raises(ValueError, match=r"x\.pt2 is no archive of an exported policy"):
        check_archive(tmp_path / "x.pt2")
