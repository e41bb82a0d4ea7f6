"""A run on its private cluster: where it listens, whom it answers, and what of its secrets reaches the disk."""

import contextlib
import ipaddress
import json
import os
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import grpc
import pytest

HERE = Path(__file__).resolve().parent
START_S = 240.0
SECRETS = {
    "WANDB_API_KEY": "c0ffee-not-a-real-key-1",
    "AWS_SECRET_ACCESS_KEY": "c0ffee-not-a-real-key-2",
    "RAY_REDIS_PASSWORD": "c0ffee-not-a-real-key-3",
}
NODES = "/ray.rpc.NodeInfoGcsService/GetAllNodeInfo"
RAYLET = "/ray.rpc.NodeManagerService/GetNodeStats"
OBJECTS = "/ray.rpc.ObjectManagerService/Pull"


@dataclass(frozen=True)
class PrivateRun:
    folder: Path
    address: str
    token: str
    token_path: Path
    listening: list[tuple[str, str, int]]

    def ports(self, process: str) -> list[int]:
        return [port for name, _, port in self.listening if process in name]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PrivateRun]:
    folder = tmp_path_factory.mktemp("private")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    child = subprocess.Popen(
        [sys.executable, str(HERE / "private_run.py"), str(folder / "run"), str(folder / "artifacts")],
        cwd=HERE.parents[1],
        env=environment | SECRETS | {"PYTHONPATH": str(HERE.parents[1])},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=(folder / "stderr").open("w"),
        text=True,
    )
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        lines = iter(child.stdout.readline, "")
        line = next((line for line in lines if line.startswith('{"listening"')), None)
        assert line, (folder / "stderr").read_text()[-4000:]
        told = json.loads(line)
        path = Path(told["token_path"])
        yield PrivateRun(folder, told["address"], path.read_text(), path, told["listening"])
        rest, _ = child.communicate("", timeout=60)
        assert json.loads(rest.splitlines()[-1]) == {"folder_left": False}
        assert child.returncode == 0
    finally:
        child.kill()
        child.wait()


def ask(port: int, method: str, metadata: dict[str, str]) -> grpc.StatusCode:
    """How a server of Ray answers an empty request."""
    with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
        try:
            channel.unary_unary(method)(b"", metadata=tuple(metadata.items()), timeout=20)
        except grpc.RpcError as error:
            return error.code()
    return grpc.StatusCode.OK


def get(port: int, path: str, headers: dict[str, str]) -> int:
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


def test_nothing_listens_beyond_the_loopback(run: PrivateRun) -> None:
    assert {"gcs_server", "raylet"} <= {name for name, _, _ in run.listening}
    addresses = {address: ipaddress.ip_address(address) for _, address, _ in run.listening}
    mapped = {a: getattr(ip, "ipv4_mapped", None) or ip for a, ip in addresses.items()}
    assert [a for a, ip in mapped.items() if not ip.is_loopback] == [], run.listening


@pytest.mark.parametrize(("process", "method"), [("gcs_server", NODES), ("raylet", RAYLET), ("raylet", OBJECTS)])
def test_cluster_refuses_whoever_has_not_the_token(run: PrivateRun, process: str, method: str) -> None:
    ports = run.ports(process)
    assert ports
    wrong = {"authorization": f"Bearer {'0' * len(run.token)}"}
    for metadata in ({}, wrong, {"authorization": "Bearer "}, {"authorization": run.token[:-1]}):
        answers = {ask(port, method, metadata) for port in ports}  # one of the ports has this service
        assert answers - {grpc.StatusCode.UNIMPLEMENTED} == {grpc.StatusCode.UNAUTHENTICATED}, sorted(metadata)
    right = {"authorization": f"Bearer {run.token}"}
    assert grpc.StatusCode.OK in {ask(port, method, right) for port in ports}


def test_agents_refuse_http_without_the_token(run: PrivateRun) -> None:
    answers: dict[str, set[int]] = {"none": set(), "wrong": set(), "right": set()}
    for port in run.ports("RuntimeEnvAgent"):
        for kind, token in (("none", ""), ("wrong", "0" * 64), ("right", run.token)):
            headers = {"Authorization": f"Bearer {token}"} if token else {}
            answers[kind].add(get(port, "/get_or_create_runtime_env", headers))
    assert answers["none"] == {401}
    assert answers["wrong"] == {403}
    assert answers["right"]
    assert not answers["right"] & {401, 403}


def test_token_is_for_its_owner_only(run: PrivateRun) -> None:
    assert run.token_path.stat().st_mode & 0o077 == 0
    assert run.token_path.parent.stat().st_mode & 0o077 == 0
    assert len(run.token) >= 64


def test_run_directory_holds_no_secret(run: PrivateRun) -> None:
    written = [path for path in run.folder.rglob("*") if path.is_file()]
    names = {path.name for path in written}
    assert {"config.json", "versions.json", "metrics.jsonl", "cluster.json"} <= names
    assert any(name.endswith(".html") for name in names), "the report is looked through as well"
    for path in written:
        content = path.read_bytes()
        for secret in (run.token, *SECRETS.values()):
            assert secret.encode() not in content, path


def test_processes_show_no_token_in_their_command_line(run: PrivateRun) -> None:
    lines = b""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):  # it may have ended since
            lines += path.read_bytes() + b"\n"
    assert b"gcs_server" in lines
    assert run.token.encode() not in lines


def test_process_can_start_one_private_cluster_after_another() -> None:
    """Ray keeps the first cluster's token as long as the process lives."""
    program = (
        "from slotfilm_dist.cluster.session import Session\n"
        "for _ in range(2):\n"
        "    session = Session(num_cpus=1)\n"
        "    print(len(session.nodes()), flush=True)\n"
        "    session.close()\n"
    )
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    child = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=START_S
    )
    assert child.returncode == 0, child.stderr[-3000:]
    assert child.stdout.split() == ["1", "1"]
