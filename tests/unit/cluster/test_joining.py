"""A run whose cluster is gone is refused at once, where Ray would try for many minutes."""

import json
import socket
import time
from pathlib import Path

import pytest

from slotfilm_dist.cluster.session import CLUSTER_FILE, joined


def write(folder: Path, **values: object) -> None:
    (folder / CLUSTER_FILE).write_text(json.dumps(values))


def test_cluster_that_is_gone_is_told_at_once(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    write(tmp_path, address=f"127.0.0.1:{port}", namespace="slotfilm-a", token_path="")
    began = time.monotonic()
    with pytest.raises(ValueError, match=f"nobody answers at 127.0.0.1:{port}.*it has ended"), joined(tmp_path):
        pass
    assert time.monotonic() - began < 5


@pytest.mark.parametrize("values", [{"address": "127.0.0.1:1"}, {"address": 7, "namespace": "a", "token_path": ""}])
def test_damaged_file_is_named(tmp_path: Path, values: dict[str, object]) -> None:
    write(tmp_path, **values)
    with pytest.raises(ValueError, match=r"cluster\.json is damaged"), joined(tmp_path):
        pass


def test_run_without_a_cluster_is_told(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="does not use Ray"), joined(tmp_path):
        pass
