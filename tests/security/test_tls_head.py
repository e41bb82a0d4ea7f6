"""A Ray head with TLS, a token and a dashboard on the loopback, as `ops/security.md` starts one."""

import datetime
import ipaddress
import os
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import grpc
import psutil
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from slotfilm_dist.doctor import check_dashboards

START_S = 90.0
NODES = "/ray.rpc.NodeInfoGcsService/GetAllNodeInfo"
TOKEN = "5" * 64
TASK = "import ray, sys; ray.init(address=sys.argv[1]); print('sum', ray.get(ray.remote(lambda: 1 + 2).remote()))"

Signed = tuple[x509.Certificate, ec.EllipticCurvePrivateKey]


@dataclass(frozen=True)
class TlsHead:
    gcs: str
    dashboard: str
    environment: dict[str, str]
    folder: Path


def certificate(name: str, signer: Signed | None = None) -> Signed:
    """A certificate of this machine's loopback for a day, signed by itself or by an authority."""
    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.datetime.now(datetime.UTC)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    names = [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
    built = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(signer[0].subject if signer else subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(minutes=5))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.BasicConstraints(ca=signer is None, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .sign(signer[1] if signer else key, hashes.SHA256())
    )
    return built, key


def write(folder: Path, name: str, signed: Signed) -> tuple[Path, Path]:
    """Files of the certificate and its key."""
    paths = folder / f"{name}.crt", folder / f"{name}.key"
    paths[0].write_bytes(signed[0].public_bytes(serialization.Encoding.PEM))
    paths[1].write_bytes(
        signed[1].private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
    )
    return paths


def free_port() -> int:
    with socket.socket() as candidate:
        candidate.bind(("127.0.0.1", 0))
        return candidate.getsockname()[1]


@pytest.fixture(scope="module")
def head() -> Iterator[TlsHead]:
    with tempfile.TemporaryDirectory(prefix="tls-", ignore_cleanup_errors=True) as short_path:
        folder = Path(short_path)
        authority = certificate("the run's authority")
        write(folder, "authority", authority)
        write(folder, "node", certificate("node", authority))
        (folder / "token").write_text(TOKEN)
        environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")} | {
            "RAY_USE_TLS": "1",
            "RAY_TLS_SERVER_CERT": str(folder / "node.crt"),
            "RAY_TLS_SERVER_KEY": str(folder / "node.key"),
            "RAY_TLS_CA_CERT": str(folder / "authority.crt"),
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN_PATH": str(folder / "token"),
            "RAY_USAGE_STATS_ENABLED": "0",
            "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
        }
        gcs, dashboard = free_port(), free_port()
        words = (
            f"start --head --block --port={gcs} --node-ip-address=127.0.0.1 --num-cpus=1 --temp-dir={folder / 'ray'}"
        )
        words += f" --dashboard-host=127.0.0.1 --dashboard-port={dashboard} --object-store-memory=80000000"
        log = (folder / "log").open("w")
        command = [str(Path(sys.executable).with_name("ray")), *words.split()]
        starter = subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        try:
            url = f"http://127.0.0.1:{dashboard}"
            deadline = time.monotonic() + START_S
            while get(f"{url}/api/version", TOKEN) != 200:
                assert time.monotonic() < deadline, (folder / "log").read_text()
                assert starter.poll() is None, (folder / "log").read_text()
                time.sleep(0.5)
            yield TlsHead(f"127.0.0.1:{gcs}", url, environment, folder)
        finally:
            end(starter)


def end(starter: subprocess.Popen) -> None:
    """End the starter and all that it started."""
    processes = [psutil.Process(starter.pid), *psutil.Process(starter.pid).children(recursive=True)]
    for process in processes:
        process.kill()
    starter.wait()
    _, alive = psutil.wait_procs(processes[1:], timeout=20)
    assert not alive


def get(url: str, token: str = "") -> int:
    """Status of an answer; 0 where there is none."""
    request = urllib.request.Request(url, headers={"Authorization": f"Bearer {token}"} if token else {})
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code
    except OSError:
        return 0


def ask(channel: grpc.Channel, token: str = "") -> grpc.StatusCode:
    metadata = (("authorization", f"Bearer {token}"),) if token else ()
    with channel:
        try:
            channel.unary_unary(NODES)(b"", metadata=metadata, timeout=10)
        except grpc.RpcError as error:
            return error.code()
    return grpc.StatusCode.OK


def credentials(head: TlsHead, name: str = "node") -> grpc.ChannelCredentials:
    return grpc.ssl_channel_credentials(
        (head.folder / "authority.crt").read_bytes(),
        (head.folder / f"{name}.key").read_bytes(),
        (head.folder / f"{name}.crt").read_bytes(),
    )


def test_head_answers_certificate_and_token_together_only(head: TlsHead) -> None:
    write(head.folder, "stranger", certificate("stranger", certificate("another authority")))
    own, stranger = credentials(head), credentials(head, "stranger")
    assert ask(grpc.secure_channel(head.gcs, own), TOKEN) == grpc.StatusCode.OK
    assert ask(grpc.secure_channel(head.gcs, own)) == grpc.StatusCode.UNAUTHENTICATED
    assert ask(grpc.secure_channel(head.gcs, own), "6" * 64) == grpc.StatusCode.UNAUTHENTICATED
    assert ask(grpc.secure_channel(head.gcs, stranger), TOKEN) == grpc.StatusCode.UNAVAILABLE
    assert ask(grpc.insecure_channel(head.gcs), TOKEN) == grpc.StatusCode.UNAVAILABLE


def test_dashboard_wants_the_token_and_doctor_sees_that(head: TlsHead) -> None:
    jobs = f"{head.dashboard}/api/jobs/"
    assert [get(jobs), get(jobs, "6" * 64), get(jobs, TOKEN)] == [401, 403, 200]
    check = check_dashboards([head.dashboard])
    assert (check.status, check.found) == ("ok", f"{head.dashboard} asks for a token")


def test_task_runs_over_tls(head: TlsHead) -> None:
    child = subprocess.run(
        [sys.executable, "-c", TASK, head.gcs], env=head.environment, capture_output=True, text=True, timeout=120
    )
    assert child.returncode == 0, child.stderr[-3000:]
    assert "sum 3" in child.stdout
