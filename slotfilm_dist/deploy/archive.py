"""Looks into a `torch.export` archive before torch does, which would run code that a forged one brings.

`torch.export.load` unpickles whatever an archive marks as pickled, parses symbolic sizes with Python's parser and looks
operators up by name anywhere in torch. An exported policy needs none of that: plain tensors, fixed sizes and ATen
operators. So anything else is refused. What this check cannot promise is that torch has no other way in: load archives
of people whom you trust, or the ONNX file, which is data.
"""

import json
import re
import zipfile
from pathlib import Path
from typing import Any

_PLAIN_MEMBERS = re.compile(
    r"[^/]+/(?:archive_format|archive_version|byteorder|\.data/version|\.data/serialization_id|models/model\.json"
    r"|data/weights/(?:weight_\d+|model_weights_config\.json)"
    r"|data/constants/(?:tensor_\d+|model_constants_config\.json))"
)
_SAMPLE_INPUTS = "/data/sample_inputs/model.pt"
_PLAIN_ARGUMENTS = frozenset(
    f"as_{kind}"
    for kind in (
        *("none", "bool", "int", "float", "string", "bools", "ints", "floats", "tensor", "tensors"),
        *("optional_tensors", "device", "layout", "scalar_type", "memory_format"),
    )
)
_NAME = re.compile(r"[A-Za-z0-9_.]*")
_OPERATORS = "torch.ops.aten."
_LARGEST_JSON = 1 << 26


def check_archive(path: Path) -> None:
    """Raise ``ValueError`` naming the file if loading it could do more than fill tensors and build a graph."""
    try:
        with zipfile.ZipFile(path) as archive:
            _check_members(archive)
            for member in archive.namelist():
                if member.endswith("_config.json"):
                    _check_payloads(_read_json(archive, member), member)
                elif member.endswith("/models/model.json"):
                    _check_graph(_read_json(archive, member))
    except (zipfile.BadZipFile, ValueError, KeyError, TypeError, RecursionError, NotImplementedError) as error:
        raise ValueError(f"{path} is no archive of an exported policy: {error}") from None


def _check_members(archive: zipfile.ZipFile) -> None:
    for member in archive.infolist():
        empty_samples = member.filename.endswith(_SAMPLE_INPUTS) and member.file_size == 0
        if not (empty_samples or _PLAIN_MEMBERS.fullmatch(member.filename)):
            raise ValueError(f"it holds {member.filename!r}, which is not needed and may be pickled")
    names = [member.filename.partition("/")[2] for member in archive.infolist()]
    if len(set(names)) != len(names) or "models/model.json" not in names:
        raise ValueError("it holds a member twice, or no models/model.json")


def _read_json(archive: zipfile.ZipFile, member: str) -> Any:
    if archive.getinfo(member).file_size > _LARGEST_JSON:
        raise ValueError(f"{member} is too large")
    return json.loads(archive.read(member))


def _check_payloads(config: Any, member: str) -> None:
    for name, payload in config["config"].items():
        if payload["use_pickle"] is not False:
            raise ValueError(f"{member}: {name} is pickled")
        if not re.fullmatch(r"(?:weight|tensor)_\d+", payload["path_name"]):
            raise ValueError(f"{member}: {name} lies in {payload['path_name']!r}")


def _check_graph(model: Any) -> None:
    if model["guards_code"] or model["range_constraints"]:
        raise ValueError("its graph brings conditions on sizes")
    graph = model["graph_module"]["graph"]
    for node in graph["nodes"]:
        if not (node["target"].startswith(_OPERATORS) and _NAME.fullmatch(node["target"])):
            raise ValueError(f"its graph calls {node['target']!r}")
    for kind in ("sym_int_values", "sym_bool_values", "sym_float_values", "custom_obj_values"):
        if graph[kind]:
            raise ValueError(f"its graph has {kind}")
    _check_arguments(graph)


def _check_arguments(value: Any) -> None:
    if isinstance(value, list):
        for item in value:
            _check_arguments(item)
    elif isinstance(value, dict):
        for key, item in value.items():
            if key.startswith("as_") and key not in _PLAIN_ARGUMENTS:
                raise ValueError(f"its graph has an argument {key!r}")
            if key == "name" and not _NAME.fullmatch(item):
                raise ValueError(f"its graph has the name {item!r}")
            if key != "metadata":
                _check_arguments(item)
