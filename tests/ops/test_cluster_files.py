"""The cluster launcher's files are what Ray accepts, and a cluster started by their commands is closed to strangers."""

import importlib.metadata
import json
import re
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import ray.autoscaler
import yaml
from ray.autoscaler._private.util import prepare_config, validate_config

from slotfilm_dist.cluster.placement import STATE_RESOURCE, WORKER_RESOURCE

ROOT = Path(__file__).parents[2]
AWS, LOCAL = ROOT / "cluster.yaml", ROOT / "ops" / "cluster-local.yaml"


def config_of(path: Path) -> dict[str, Any]:
    return yaml.safe_load(path.read_text())


def started_by(commands: list[str]) -> str:
    """The command that starts Ray."""
    (command,) = [line for line in commands if "ray start" in line]
    return command


@pytest.mark.parametrize("path", [AWS, LOCAL], ids=lambda path: path.name)
def test_file_fits_rays_schema(path: Path) -> None:
    schema = json.loads((Path(ray.autoscaler.__file__).parent / "ray-schema.json").read_text())
    jsonschema.validate(config_of(path), schema)


@pytest.mark.parametrize("path", [AWS, LOCAL], ids=lambda path: path.name)
def test_file_is_filled_out_and_validated_by_ray(path: Path) -> None:
    filled = prepare_config(config_of(path))
    validate_config(filled)
    assert all("max_workers" in node for node in filled["available_node_types"].values())


@pytest.mark.parametrize("path", [AWS, LOCAL], ids=lambda path: path.name)
def test_every_node_asks_for_the_token_and_opens_the_dashboard_to_nobody(path: Path) -> None:
    config = config_of(path)
    head, worker = started_by(config["head_start_ray_commands"]), started_by(config["worker_start_ray_commands"])
    for command in (head, worker):
        assert "RAY_AUTH_MODE=token" in command
        assert "RAY_AUTH_TOKEN_PATH=~/.ray/auth_token" in command
        assert "ulimit -n 65536" in command
        assert "--metrics-export-port=8080" in command
        assert "--object-store-memory=" in command
    assert "--dashboard-host=127.0.0.1" in head
    assert "--num-cpus=0" in head
    assert "0.0.0.0" not in path.read_text()
    assert config["file_mounts"]["~/.ray/auth_token"] == "~/.ray/auth_token"
    assert set(config["rsync_exclude"]) >= {".git", ".venv", "runs", "artifacts"}


def test_state_stays_off_spot_machines_and_workers_go_there() -> None:
    nodes = config_of(AWS)["available_node_types"]
    spot = {name for name, node in nodes.items() if "InstanceMarketOptions" in node["node_config"]}
    assert spot == {name for name, node in nodes.items() if WORKER_RESOURCE in node["resources"]} == {"worker"}
    assert {name for name, node in nodes.items() if STATE_RESOURCE in node["resources"]} == {"learner", "replay"}
    assert {name: node["resources"].get("GPU", 0) for name, node in nodes.items() if "GPU" in node["resources"]} == {
        "learner": 1
    }
    assert nodes["head"]["resources"] == {"CPU": 0}
    assert 0 < nodes["worker"]["min_workers"] < nodes["worker"]["max_workers"]
    assert sum(node.get("max_workers", 0) for node in nodes.values()) <= config_of(AWS)["max_workers"]


def test_security_group_lets_in_nothing_but_ssh() -> None:
    (rule,) = config_of(AWS)["provider"]["security_group"]["IpPermissions"]
    assert (rule["FromPort"], rule["ToPort"], rule["IpProtocol"]) == (22, 22, "tcp")
    assert all(not one["CidrIp"].endswith("/0") for one in rule["IpRanges"])


def test_nodes_install_what_is_pinned() -> None:
    pins = dict(re.findall(r"^([a-z0-9-]+)==(\S+)$", (ROOT / "ops" / "constraints.txt").read_text(), re.MULTILINE))
    needed = [
        re.split(r"[\[<>=]", line)[0]
        for line in importlib.metadata.requires("slotfilm-dist") or ()
        if "extra" not in line
    ]
    assert len(needed) > 15
    assert [name for name in needed if name not in pins] == []
    for path in (AWS, LOCAL):
        assert any("-c ops/constraints.txt" in line for line in config_of(path)["setup_commands"])


def test_cluster_of_two_nodes_starts_from_the_local_file_and_refuses_who_has_no_token(home: Any) -> None:
    """Ray's own start commands of `ops/cluster-local.yaml`, for a head and one worker on this machine."""
    config = config_of(LOCAL)
    config["provider"] |= {"head_ip": "127.0.0.1", "worker_ips": []}  # the test starts the worker itself, without ssh
    (home.folder / "ray_bootstrap_config.yaml").write_text(yaml.safe_dump(prepare_config(config)))
    (home.folder / "slotfilm-resources.json").write_text(json.dumps({STATE_RESOURCE: 1000}))
    gcs, dashboard, first, second = home.free_ports(4)
    head = started_by(config["head_start_ray_commands"]).replace("6379", str(gcs)).replace("8265", str(dashboard))
    home.start(head.replace("8080", str(first)) + f" --temp-dir={home.folder} --block")
    page = f"http://127.0.0.1:{dashboard}"
    home.wait("dashboard", lambda: home.get(page + "/api/version", home.token)[0] == 200)
    worker = started_by(config["worker_start_ray_commands"]).replace("$RAY_HEAD_IP:6379", f"127.0.0.1:{gcs}")
    home.start(worker.replace("8080", str(second)) + " --num-cpus=1 --block")

    discovery = home.folder / "prom_metrics_service_discovery.json"
    home.wait("list of both nodes", lambda: discovery.exists() and f":{second}" in discovery.read_text())
    (listed,) = json.loads(discovery.read_text())
    ports = {int(target.rpartition(":")[2]) for target in listed["targets"]}
    assert listed["labels"] == {"job": "ray"}
    assert ports > {first, second}
    metrics = f"http://127.0.0.1:{second}/metrics"
    home.wait("metrics of the worker's node", lambda: "ray_node_mem_total" in home.get(metrics)[1])

    for path in ("/api/jobs/", "/api/v0/nodes", "/nodes?view=summary"):
        assert home.get(page + path)[0] == 401, path
        assert home.get(page + path, "0" * 64)[0] == 403, path
        assert home.get(page + path, home.token)[0] == 200, path
    status = json.loads(home.get(page + "/api/v0/nodes?detail=1", home.token)[1])["data"]["result"]["result"]
    resources = {node["is_head_node"]: node["resources_total"] for node in status}
    assert "CPU" not in resources[True]
    assert resources[False][STATE_RESOURCE] == 1000
    assert resources[False]["CPU"] == 1
