"""The KubeRay manifests and the container recipe, field by field."""

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import yaml

from slotfilm_dist.cluster.placement import STATE_RESOURCE, WORKER_RESOURCE

ROOT = Path(__file__).parents[2]
KUBERAY = ROOT / "ops" / "kuberay"
CLUSTER_FIELDS = {
    *("authOptions", "suspend", "managedBy", "autoscalerOptions", "headServiceAnnotations", "enableInTreeAutoscaling"),
    *("gcsFaultToleranceOptions", "headGroupSpec", "rayVersion", "workerGroupSpecs"),
}
JOB_FIELDS = {
    *("activeDeadlineSeconds", "backoffLimit", "rayClusterSpec", "submitterPodTemplate", "metadata", "clusterSelector"),
    *("submitterConfig", "managedBy", "deletionStrategy", "entrypoint", "runtimeEnvYAML", "jobId", "submissionMode"),
    *("entrypointResources", "entrypointNumCpus", "entrypointNumGpus", "ttlSecondsAfterFinished", "suspend"),
    "shutdownAfterJobFinishes",
}
GROUP_FIELDS = {
    *("groupName", "replicas", "minReplicas", "maxReplicas", "idleTimeoutSeconds", "numOfHosts", "rayStartParams"),
    *("template", "scaleStrategy", "suspend", "serviceType", "headService", "enableIngress"),
}
"""Fields of KubeRay's `ray.io/v1` types, from their definition."""
POLICY, CLAIM, CLUSTER = yaml.safe_load_all((KUBERAY / "cluster.yaml").read_text())
JOB = yaml.safe_load((KUBERAY / "grid.yaml").read_text())
SPEC = CLUSTER["spec"]
GROUPS = [SPEC["headGroupSpec"], *SPEC["workerGroupSpecs"]]
SUBMITTER = JOB["spec"]["submitterPodTemplate"]
PODS = [*(group["template"] for group in GROUPS), SUBMITTER]
BY_NAME = {group.get("groupName", "head"): group for group in GROUPS}
RECIPE = (ROOT / "ops" / "container" / "Containerfile").read_text()


def container_of(pod: dict[str, Any]) -> dict[str, Any]:
    (container,) = pod["spec"]["containers"]
    return container


def test_manifests_use_fields_that_kuberay_has() -> None:
    assert CLUSTER["apiVersion"] == JOB["apiVersion"] == "ray.io/v1"
    assert (CLUSTER["kind"], JOB["kind"]) == ("RayCluster", "RayJob")
    assert SPEC.keys() <= CLUSTER_FIELDS
    assert JOB["spec"].keys() <= JOB_FIELDS
    for group in GROUPS:
        assert group.keys() <= GROUP_FIELDS
        assert all(isinstance(value, str) for value in group["rayStartParams"].values())
    assert {container_of(group["template"])["name"] for group in SPEC["workerGroupSpecs"]} == {"ray-worker"}
    assert container_of(SPEC["headGroupSpec"]["template"])["name"] == "ray-head"
    assert SPEC["autoscalerOptions"]["version"] == "v2"


def test_job_and_cluster_are_the_same_cluster() -> None:
    assert JOB["spec"]["rayClusterSpec"] == SPEC


def test_ray_is_the_version_that_is_pinned() -> None:
    assert f"ray=={SPEC['rayVersion']}" in (ROOT / "ops" / "constraints.txt").read_text().splitlines()


@pytest.mark.parametrize("pod", PODS)
def test_every_pod_asks_for_the_token(pod: dict[str, Any]) -> None:
    values = {one["name"]: one.get("value") or one["valueFrom"] for one in container_of(pod)["env"]}
    assert values["RAY_AUTH_MODE"] == "token"
    assert values["RAY_AUTH_TOKEN"] == {"secretKeyRef": {"name": "slotfilm-token", "key": "auth_token"}}


@pytest.mark.parametrize("pod", PODS)
def test_no_pod_runs_as_root_or_can_become_it(pod: dict[str, Any]) -> None:
    user, container = pod["spec"]["securityContext"], container_of(pod)["securityContext"]
    assert user["runAsNonRoot"] is True
    assert user["runAsUser"] == 1000
    assert user["seccompProfile"] == {"type": "RuntimeDefault"}
    assert container["allowPrivilegeEscalation"] is False
    assert container["capabilities"] == {"drop": ["ALL"]}


@pytest.mark.parametrize("pod", PODS)
def test_every_pod_is_under_the_network_policy_and_says_what_it_needs(pod: dict[str, Any]) -> None:
    assert pod["metadata"]["labels"].items() >= POLICY["spec"]["podSelector"]["matchLabels"].items()
    resources = container_of(pod)["resources"]
    assert resources["requests"].keys() >= {"cpu", "memory"}
    assert "memory" in resources["limits"]


@pytest.mark.parametrize("group", GROUPS, ids=BY_NAME)
def test_every_node_is_probed_and_has_shared_memory_and_the_runs(group: dict[str, Any]) -> None:
    container = container_of(group["template"])
    for probe in (container["readinessProbe"], container["livenessProbe"]):
        assert "local_raylet_healthz" in probe["exec"]["command"][-1]
    assert container["livenessProbe"]["failureThreshold"] > container["readinessProbe"]["failureThreshold"]
    mounts = {mount["mountPath"]: mount["name"] for mount in container["volumeMounts"]}
    volumes = {volume["name"]: volume for volume in group["template"]["spec"]["volumes"]}
    assert volumes[mounts["/dev/shm"]]["emptyDir"]["medium"] == "Memory"
    assert volumes[mounts["/runs"]]["persistentVolumeClaim"]["claimName"] == CLAIM["metadata"]["name"]
    assert group["rayStartParams"]["metrics-export-port"] == "8080"


def test_policy_lets_in_only_the_cluster_the_operator_and_prometheus() -> None:
    spec = POLICY["spec"]
    assert set(spec["policyTypes"]) == {"Ingress", "Egress"}
    own, operator, prometheus = spec["ingress"]
    assert own == {"from": [{"podSelector": spec["podSelector"]}]}
    assert [port["port"] for port in operator["ports"]] == [8265]
    assert 8265 not in [port["port"] for port in prometheus["ports"]]


def test_state_and_workers_are_where_placement_puts_them() -> None:
    offered = {
        name: json_of(group["rayStartParams"]["resources"])
        for name, group in BY_NAME.items()
        if "resources" in group["rayStartParams"]
    }
    assert offered == {
        "learner": {STATE_RESOURCE: 1000},
        "replay": {STATE_RESOURCE: 1000},
        "workers": {WORKER_RESOURCE: 1000},
    }
    assert BY_NAME["head"]["rayStartParams"]["num-cpus"] == "0"
    spot = {
        name for name, group in BY_NAME.items() if "slotfilm/spot" in str(group["template"]["spec"].get("tolerations"))
    }
    assert spot == {"workers"}


def json_of(parameter: str) -> dict[str, int]:
    """What `ray start` is given: KubeRay puts the parameter into a shell's command line."""
    (word,) = shlex.split(parameter)
    return yaml.safe_load(word)


def test_job_ends_begins_again_and_clears_up() -> None:
    spec = JOB["spec"]
    assert spec["backoffLimit"] > 0
    assert spec["shutdownAfterJobFinishes"] is True
    assert 0 < spec["ttlSecondsAfterFinished"] <= 86_400
    assert spec["activeDeadlineSeconds"] > 86_400
    program, script, *_ = shlex.split(spec["entrypoint"])
    assert program == "python"
    assert (ROOT / script).exists()


def test_images_are_the_flavours_of_the_recipe() -> None:
    stages = re.findall(r"^FROM \S+ AS (\w+)$", RECIPE, re.MULTILINE)
    assert {container_of(pod)["image"] for pod in PODS} == {"slotfilm:cpu", "slotfilm:gpu"}
    assert {"cpu", "gpu"} <= set(stages)


def test_recipe_installs_what_is_pinned_and_ends_as_a_plain_user() -> None:
    assert "--constraint constraints.txt" in RECIPE
    for flavour in ("cpu", "gpu"):
        stage = RECIPE.split(f"AS {flavour}\n")[1].split("\nFROM ")[0]
        users = re.findall(r"^USER (\S+)$", stage, re.MULTILINE) or re.findall(r"^USER (\S+)$", RECIPE, re.MULTILINE)
        assert users[-1] == "1000:1000"
    assert "mesa-vulkan-drivers" in RECIPE.split("AS cpu\n")[1]
    copied = re.findall(r"^COPY (?!--from)(?:--chown=\S+ )?(.+) \S+$", RECIPE, re.MULTILINE)
    assert all((ROOT / source).exists() for line in copied for source in line.split())
