"""The KubeRay manifests and the container recipe, field by field."""

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from slotfilm_dist.cluster.placement import STATE_RESOURCE, WORKER_RESOURCE
from slotfilm_dist.presets import steady
from slotfilm_dist.tuning.jobs import build_jobs, build_trials, select_variants
from slotfilm_dist.tuning.resources import job_resources, num_that_fit, runs_on_ray

ROOT = Path(__file__).parents[2]
KUBERAY = ROOT / "ops" / "kuberay"
WORDS = {
    "serviceType": {"ClusterIP"},
    "version": {"v1", "v2"},
    "upscalingMode": {"Default", "Aggressive", "Conservative"},
}
WORDS |= {"submissionMode": {"K8sJobMode", "HTTPMode", "InteractiveMode"}}
"""The only words that fields take."""
CLUSTER_FIELDS = {
    **{"suspend": bool, "managedBy": str, "autoscalerOptions": dict, "headServiceAnnotations": dict},
    **{"enableInTreeAutoscaling": bool, "gcsFaultToleranceOptions": dict, "headGroupSpec": dict, "rayVersion": str},
    "workerGroupSpecs": list,
}
AUTOSCALER_FIELDS = {
    **{"resources": dict, "image": str, "imagePullPolicy": str, "securityContext": dict, "idleTimeoutSeconds": int},
    **{"upscalingMode": str, "version": str, "env": list, "envFrom": list, "volumeMounts": list},
}
HEAD_FIELDS = {
    **{"template": dict, "headService": dict, "enableIngress": bool, "rayStartParams": dict, "serviceType": str},
}
GROUP_FIELDS = {
    **{"suspend": bool, "groupName": str, "replicas": int, "minReplicas": int, "maxReplicas": int},
    **{"idleTimeoutSeconds": int, "rayStartParams": dict, "template": dict, "scaleStrategy": dict, "numOfHosts": int},
}
JOB_FIELDS = {
    **{"activeDeadlineSeconds": int, "backoffLimit": int, "rayClusterSpec": dict, "submitterPodTemplate": dict},
    **{"metadata": dict, "clusterSelector": dict, "submitterConfig": dict, "managedBy": str, "deletionStrategy": dict},
    **{"entrypoint": str, "runtimeEnvYAML": str, "jobId": str, "submissionMode": str, "entrypointResources": str},
    **{"entrypointNumCpus": float, "entrypointNumGpus": float, "ttlSecondsAfterFinished": int, "suspend": bool},
    "shutdownAfterJobFinishes": bool,
}
"""Fields of KubeRay's `ray.io/v1` types with their types, from the reference of its API."""
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


def misfits(values: dict[str, Any], fields: dict[str, type], required: set[str]) -> list[str]:
    """What the API server would refuse in an object of KubeRay's."""
    wrong = [name for name, value in values.items() if name not in fields or type(value) is not fields[name]]
    return (
        wrong
        + [name for name in required - values.keys()]
        + [n for n in WORDS.keys() & values if values[n] not in WORDS[n]]
    )


def test_manifests_use_fields_that_kuberay_has_as_it_has_them() -> None:
    assert CLUSTER["apiVersion"] == JOB["apiVersion"] == "ray.io/v1"
    assert (CLUSTER["kind"], JOB["kind"]) == ("RayCluster", "RayJob")
    assert misfits(SPEC, CLUSTER_FIELDS, {"headGroupSpec"}) == []
    assert misfits(SPEC["autoscalerOptions"], AUTOSCALER_FIELDS, set()) == []
    assert misfits(SPEC["headGroupSpec"], HEAD_FIELDS, {"rayStartParams", "template"}) == []
    assert misfits(JOB["spec"], JOB_FIELDS, set()) == []
    assert misfits(JOB["spec"]["submitterConfig"], {"backoffLimit": int}, set()) == []
    for group in SPEC["workerGroupSpecs"]:
        wanted = {"groupName", "minReplicas", "maxReplicas", "rayStartParams", "template"}
        assert misfits(group, GROUP_FIELDS, wanted) == []
        assert group["minReplicas"] <= group["replicas"] <= group["maxReplicas"]
    for group in GROUPS:
        assert all(isinstance(value, str) for value in group["rayStartParams"].values())
    assert {container_of(group["template"])["name"] for group in SPEC["workerGroupSpecs"]} == {"ray-worker"}
    assert container_of(SPEC["headGroupSpec"]["template"])["name"] == "ray-head"


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


def test_every_trial_of_the_grid_finds_a_node_that_holds_it() -> None:
    spec = JOB["spec"]["rayClusterSpec"]
    nodes = [_as_ray_sees(group) for group in spec["workerGroupSpecs"]]
    words = shlex.split(JOB["spec"]["entrypoint"])
    assert words[:3] == ["python", "jobs/grid.py", "steady"]
    gpus = float(words[words.index("--gpus-per-trial") + 1])
    for job in build_jobs(build_trials(steady(), select_variants([], []), 1)):
        mode = "ray" if runs_on_ray(job.config, nodes) else "local"
        job = replace(job, config=replace(job.config, runtime=replace(job.config.runtime, mode=mode)))
        given = job_resources(job, nodes, gpus_per_trial=gpus)
        assert num_that_fit(given, nodes), f"{job.key} asks for {given.bundles}"


def _as_ray_sees(group: dict[str, Any]) -> dict[str, float]:
    limits = container_of(group["template"])["resources"]
    own = json.loads(json.loads(group["rayStartParams"].get("resources", '"{}"')))
    memory = {"Gi": 1 << 30}[limits["limits"]["memory"][-2:]] * int(limits["limits"]["memory"][:-2])
    gpus = {"GPU": float(limits["limits"]["nvidia.com/gpu"])} if "nvidia.com/gpu" in limits["limits"] else {}
    return {"CPU": float(limits["requests"]["cpu"]), "memory": float(memory), **gpus, **own}
