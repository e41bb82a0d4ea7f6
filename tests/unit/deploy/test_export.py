"""An exported policy does what the agent does, in a process that knows neither the simulator nor Ray."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch

from slotfilm_dist.__main__ import main
from slotfilm_dist.config import RunConfig
from slotfilm_dist.deploy.export import COMPARISONS, export_policy, policy_inputs, random_observation
from slotfilm_dist.deploy.loader import FILES, MANIFEST, load_policy
from slotfilm_dist.learning.learner import Learner
from slotfilm_dist.messages import Observation
from slotfilm_dist.policy import AgentPolicy
from slotfilm_dist.presets import smoke
from slotfilm_dist.variants import apply_variant

ACTION_DIM = 7
TOLERANCE = 1e-4
"""Of an action: rounding stays well below it, a wrong weight mostly moves actions by some thousandths."""
READ_BY = {
    "slotfilm": ("rgb", "proprio"),
    "slotfilm_goal": ("rgb", "proprio", "goal"),
    "state_only": ("proprio",),
    "drq_state": ("rgb", "proprio"),
    "drqv2": ("rgb",),
}
"""What each of these variants reads: slots with and without goal, the state alone, pixels on both algorithms."""
AS_ONNX = ("slotfilm_goal", "state_only", "drqv2")
CHILD = """
import sys
from pathlib import Path
import numpy as np
from slotfilm_dist.deploy.loader import load_policy
folder, backend = Path(sys.argv[1]), sys.argv[2]
for variant in folder.iterdir():
    if not list(variant.glob({"torch": "*/*.pt2", "onnx": "*/*.onnx"}[backend])):
        continue
    given = np.load(variant / "observations.npz", allow_pickle=False)
    policy = load_policy(variant / "policy", backend)
    rows = [policy.act(**{name: given[name][i] for name in policy.inputs}) for i in range(len(given["action"]))]
    print(variant.name, np.abs(np.stack(rows) - given["action"]).max())
print(" ".join(sorted({name.split(".")[0] for name in sys.modules})))
"""


def tiny(variant: str, precision: Literal["float32", "bfloat16"] = "float32") -> RunConfig:
    config = apply_variant(variant, smoke())
    return replace(
        config,
        env=replace(config.env, image_size=64),
        obs=replace(config.obs, normalize_state=True),
        encoder=replace(config.encoder, backbone="random", frozen_precision=precision),
        sac=replace(config.sac, hidden=(32, 32)),
        ddpg=replace(config.ddpg, hidden=(32, 32)),
    )


def altered(variant: str, precision: Literal["float32", "bfloat16"] = "float32") -> Learner:
    """An agent whose every weight and statistic is away from where it begins."""
    config = tiny(variant, precision)
    learner = Learner(config, ACTION_DIM, torch.device("cpu"), fetch_weights=False)
    learner.begin_rl(None)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in [*learner.encoder.fusion_parameters(), *learner.rl.actor.parameters()]:
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
    learner.encoder.set_state_statistics(torch.linspace(-1, 1, 35), torch.linspace(0.5, 2, 35))
    return learner


def own_actions(learner: Learner, observations: dict[str, np.ndarray]) -> np.ndarray:
    """What the agent does in training's own evaluation."""
    count = len(next(iter(observations.values())))
    observation = Observation(
        rgb=observations.get("rgb"),
        proprio=observations.get("proprio", np.zeros((count, 35), np.float32)),
        goal=observations.get("goal", np.zeros((count, 3), np.float32)),
        uv=np.zeros((count, 2, 2), np.float32),
        visible=np.zeros((count, 2), bool),
    )
    policy = AgentPolicy(learner.encoder, learner.rl.actor, np.random.SeedSequence(0), deterministic=True)
    return policy.act(observation, policy.visual(observation))


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory, write_agent_run: Callable[..., Path]) -> Path:
    """A folder for each variant: its exported policy, observations, and what the agent itself does at them.

    The agent of the run acts in bfloat16; what is exported, and compared with, is the same agent in float32.
    """
    folder = tmp_path_factory.mktemp("exported")
    for variant in READ_BY:
        run = tmp_path_factory.mktemp("runs") / "run"
        acting, learner = altered(variant, "bfloat16"), altered(variant)
        write_agent_run(run, acting.config, acting)
        formats = ("torch", "onnx") if variant in AS_ONNX else ("torch",)
        export_policy(run, folder / variant / "policy", formats=formats, tolerance=TOLERANCE)
        rng, inputs = np.random.default_rng(7), policy_inputs(learner.config)
        drawn = [random_observation(inputs, rng, learner.encoder) for _ in range(20)]
        observations = {name: np.stack([one[name] for one in drawn]) for name in inputs}
        actions = own_actions(learner, observations)
        np.savez(folder / variant / "observations.npz", **observations, action=actions)
    return folder


@pytest.mark.parametrize("backend", ["torch", "onnx"])
def test_fresh_process_acts_alike_without_simulator_and_ray(exported: Path, backend: str) -> None:
    child = subprocess.run(
        [sys.executable, "-c", CHILD, str(exported), backend],
        cwd=Path(__file__).resolve().parents[3],
        capture_output=True,
        text=True,
        timeout=400,
    )
    assert child.returncode == 0, child.stderr
    *lines, modules = child.stdout.splitlines()
    differences = {name: float(value) for name, value in map(str.split, lines)}
    assert differences.keys() == set(READ_BY if backend == "torch" else AS_ONNX)
    assert max(differences.values()) <= TOLERANCE, differences
    unwanted = {"sapien", "mani_skill", "gymnasium", "ray", "torchvision"} | ({"torch"} if backend == "onnx" else set())
    assert not unwanted & set(modules.split())


@pytest.mark.parametrize("variant", READ_BY)
def test_policy_says_what_it_reads_and_how_that_is_normalised(exported: Path, variant: str) -> None:
    manifest = json.loads((exported / variant / "policy" / MANIFEST).read_text())
    assert tuple(manifest["inputs"]) == READ_BY[variant]
    assert manifest["config"]["variant"] == variant
    assert manifest["action"]["size"] == ACTION_DIM
    assert (manifest["env_steps"], manifest["updates"]) == (12, 0)
    assert sum(manifest["state_fields"].values()) == 35
    if "proprio" in READ_BY[variant]:
        assert manifest["normalization"]["proprio"]["mean"] == pytest.approx(np.linspace(-1, 1, 35), abs=1e-6)
    for backend, file in manifest["files"].items():
        assert file["file"] == FILES[backend]
        assert 0 <= file["max_difference"] <= TOLERANCE
        assert 0 < file["latency_ms_mean"] < 1000


def test_every_input_changes_the_action(exported: Path) -> None:
    given = np.load(exported / "slotfilm_goal" / "observations.npz")
    policy = load_policy(exported / "slotfilm_goal" / "policy")
    in_view = next(i for i in range(len(given["goal"])) if given["goal"][i, 2] == 1)
    base = {name: given[name][in_view] for name in policy.inputs}
    for name, changed in (
        ("rgb", 255 - base["rgb"]),
        ("proprio", base["proprio"] + 1),
        ("goal", np.array([0.1, 0.9, 1], np.float32)),
    ):
        assert np.abs(policy.act(**base | {name: changed}) - policy.act(**base)).max() > 1e-4, name


def test_exported_files_name_no_path_of_this_machine(exported: Path) -> None:
    here = str(Path(__file__).resolve().parents[3]).encode()
    for path in exported.glob("*/policy/*"):
        assert here not in path.read_bytes(), path
        assert str(exported.parent).encode() not in path.read_bytes(), path


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda o: o | {"rgb": o["rgb"].astype(np.float32)}, r"rgb is float32 .*, must be uint8"),
        (lambda o: o | {"proprio": o["proprio"][:34]}, r"proprio is float32 \(34,\), must be float32 \(35,\)"),
        (lambda o: o | {"depth": np.zeros(3, np.float32)}, "'depth' is missing or unknown; give rgb, proprio, goal"),
        (lambda o: {"rgb": o["rgb"], "goal": o["goal"]}, "'proprio' is missing"),
        (lambda o: o | {"proprio": np.full(35, np.nan, np.float32)}, "not finite"),
    ],
    ids=["type", "shape", "unknown", "missing", "nan"],
)
@pytest.mark.parametrize("backend", ["torch", "onnx"])
def test_wrong_observation_is_refused(
    exported: Path, backend: str, change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]], complaint: str
) -> None:
    policy = load_policy(exported / "slotfilm_goal" / "policy", backend)
    observation = random_observation(policy.inputs, np.random.default_rng(0), altered("slotfilm_goal").encoder)
    with pytest.raises(ValueError, match=complaint):
        policy.act(**change(observation))


@pytest.mark.parametrize("name", [MANIFEST, "policy.pt2", "policy.onnx"])
def test_damaged_file_is_refused_and_named(exported: Path, tmp_path: Path, name: str) -> None:
    backend = "onnx" if name == "policy.onnx" else "torch"
    shutil.copytree(exported / "state_only" / "policy", tmp_path / "policy")
    path = tmp_path / "policy" / name
    content = path.read_bytes()
    load_policy(tmp_path / "policy", backend)
    changed = bytearray(content)
    changed[len(content) // 2] ^= 0x80
    for damaged in (bytes(changed), content[: len(content) // 2], b"", b"[]", b"[" * 100_000, None):
        path.unlink() if damaged is None else path.write_bytes(damaged)
        with pytest.raises(ValueError, match=name.replace(".", r"\.")):
            load_policy(tmp_path / "policy", backend)


def test_command_reports_latency_and_difference(
    tmp_path: Path, write_agent_run: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    write_agent_run(tmp_path / "run", tiny("state_only"), altered("state_only"))
    assert main(["export", str(tmp_path / "run"), "--format", "torch", "--tolerance", str(TOLERANCE), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["out"] == str(tmp_path / "run" / "export")
    assert result["files"].keys() == {"torch"}
    assert result["files"]["torch"]["latency_ms_mean"] > 0
    assert result["files"]["torch"]["max_difference"] <= TOLERANCE
    with pytest.raises(ValueError, match="holds no onnx policy; export it again"):
        load_policy(tmp_path / "run" / "export", "onnx")


def test_difference_beyond_the_tolerance_leaves_nothing_behind(
    tmp_path: Path, write_agent_run: Callable[..., Path]
) -> None:
    write_agent_run(tmp_path / "run", tiny("drqv2"), altered("drqv2"))
    with pytest.raises(ValueError, match=r"policy\.onnx differs from the agent by .*--tolerance"):
        export_policy(tmp_path / "run", tmp_path / "out", formats=("onnx",), tolerance=-1.0)
    assert COMPARISONS > 10
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run"]


def test_what_is_no_run_or_no_place_is_refused(
    tmp_path: Path, write_agent_run: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(tmp_path / "nowhere")]) == 2
    assert "is no run directory: it has no config.json" in capsys.readouterr().err
    write_agent_run(tmp_path / "run", tiny("state_only"), altered("state_only"))
    assert main(["export", str(tmp_path / "run"), "--out", str(tmp_path / "run"), "--format", "torch"]) == 2
    assert "holds no exported policy; choose another --out" in capsys.readouterr().err
    assert (tmp_path / "run" / "config.json").exists()
    assert main(["export", str(tmp_path / "run"), "--checkpoint", "best", "--format", "torch"]) == 2
    assert "best" in capsys.readouterr().err
