"""The layering of the package, checked on the source of every file: imports point downwards only."""

import ast
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import pytest

PACKAGE = "slotfilm_dist"
ROOT = Path(__file__).resolve().parents[2] / PACKAGE

LEVELS: dict[str, int] = {
    "": 0,  # the package itself: its version
    "config": 0,
    "config_files": 0,
    "variants": 0,
    "presets": 0,
    "messages": 0,
    "contracts": 0,
    "metrics": 0,
    "atomic": 0,
    "weights_file": 0,
    "machine": 0,
    "dashboards": 0,
    "backend": 0,
    "seeds": 0,
    "stopping": 0,
    "artifacts": 4,
    "envs": 1,
    "nets": 1,
    "replay": 1,
    "sinks": 1,
    "deploy": 1,
    "deploy.export": 4,
    "policy": 2,
    "learning": 2,  # losses and other pure functions; the loops are named below
    "learning.learner": 3,
    "learning.pretraining_files": 3,
    "learning.recovery": 3,
    "learning.graphed_sac": 3,
    "learning.sac": 3,
    "learning.ddpg": 3,
    "learning.pretrain": 3,
    "episodes": 2,
    "rejection": 2,
    "rollout": 3,
    "progress": 3,
    "evaluation": 3,
    "cluster": 4,
    "local": 4,
    "local_envs": 4,
    "doctor": 4,
    "runs": 4,
    "saving": 4,
    "run_sinks": 5,
    "pipeline": 5,
    "driver": 5,
    "chaos": 5,
    "bench": 5,
    "commands": 5,
    "tuning": 5,
    "__main__": 5,
}
"""Level of a module or of everything below a package; the longest name that fits counts."""

SAME_LEVEL = {
    ("__main__", "commands"),
    ("__main__", "tuning"),
    ("commands", "bench"),
    ("commands", "tuning"),
    ("commands", "pipeline"),
    ("commands", "driver"),
    ("commands", "chaos"),
    ("driver", "pipeline"),
    ("local", "local_envs"),
    ("chaos", "driver"),
    ("chaos", "pipeline"),
    ("tuning", "pipeline"),
    ("pipeline", "run_sinks"),
}
"""The command line is the one place that reaches sideways: it starts the others."""

HOMES: dict[str, tuple[str, ...]] = {
    "ray": ("cluster", "tuning"),
    "mani_skill": ("envs",),
    "sapien": ("envs",),
}

PEERS = "bench.peers."
"""Scripts that run other people's software in processes of their own; they may import what they are compared with."""
"""Top-level names that may import a third-party package, lazily or not."""

NARROW: dict[str, set[str]] = {"replay": {"numpy", "jaxtyping", "msgpack"}}
"""Top-level names that import nothing else from outside: replay computes in numpy and writes msgpack."""

PICKLES = {"pickle", "cPickle", "_pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}
VAGUE_NAMES = {"utils", "util", "helpers", "helper", "common", "misc"}
MAX_LINES = 350
MAX_FUNCTION_LINES = 60
LONGER_FILES = {"config": 700}
"""Files that may be longer than the rest: the config is one flat list of settings with their help."""


@dataclass(frozen=True)
class Source:
    """One file of the package."""

    module: str
    """Dotted name without the package's."""
    text: str

    @cached_property
    def tree(self) -> ast.Module:
        return ast.parse(self.text)

    @property
    def top(self) -> str:
        return self.module.split(".")[0]


@cache
def package_sources() -> list[Source]:
    sources: list[Source] = []
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        sources.append(Source(module, path.read_text(encoding="utf-8")))
    return sources


def level_of(module: str) -> int:
    parts = module.split(".")
    for length in range(len(parts), 0, -1):
        if (name := ".".join(parts[:length])) in LEVELS:
            return LEVELS[name]
    raise AssertionError(f"{PACKAGE}/{module.replace('.', '/')} has no level: give it one in LEVELS")


def imported_names(source: Source) -> Iterator[str]:
    """Every imported dotted name, at any depth of the file; `from a import b` gives `a.b`."""
    for node in ast.walk(source.tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{source.module}: import from the full name of the module, not a relative one"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def upward_imports(source: Source) -> list[str]:
    own = level_of(source.module)
    wrong: list[str] = []
    for name in imported_names(source):
        if name.split(".")[0] != PACKAGE or name == PACKAGE:
            continue
        target = name.removeprefix(f"{PACKAGE}.")
        if target.startswith("__") and target != "__main__":
            continue  # the version
        level, top = level_of(target), target.split(".")[0]
        sideways = level == own and (own == 0 or top == source.top or (source.top, top) in SAME_LEVEL)
        if not (level < own or sideways):
            wrong.append(f"{source.module} (level {own}) imports {target} (level {level})")
    return wrong


def misplaced_packages(source: Source) -> list[str]:
    wrong: list[str] = []
    for name in imported_names(source):
        root = name.split(".")[0]
        third_party = root != PACKAGE and root not in sys.stdlib_module_names
        if root in HOMES and source.top not in HOMES[root] and not source.module.startswith(PEERS):
            wrong.append(f"{source.module} imports {root}, which belongs in {' and '.join(HOMES[root])}")
        elif third_party and level_of(source.module) == 0 and root not in {"numpy", "jaxtyping"}:
            wrong.append(f"{source.module} imports {root}; level 0 has only numpy and jaxtyping")
        elif third_party and root not in NARROW.get(source.top, {root}):
            wrong.append(
                f"{source.module} imports {root}; {source.top} has only {', '.join(sorted(NARROW[source.top]))}"
            )
    return wrong


def unsafe_loading(source: Source) -> list[str]:
    """Pickle in any disguise: a checkpoint or a message must never run code."""
    names = [n for n in imported_names(source) if n.split(".")[0] in PICKLES and n != "pickle.UnpicklingError"]
    wrong = [f"{source.module} imports {n}" for n in names]
    for node in ast.walk(source.tree):
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        given = {k.arg: ast.unparse(k.value) for k in node.keywords}
        if called == "torch.load" and given.get("weights_only") != "True":
            wrong.append(f"{source.module}:{node.lineno} calls torch.load without weights_only=True")
        if given.get("allow_pickle", "False") != "False":
            wrong.append(f"{source.module}:{node.lineno} allows pickle")
    return wrong


def misplaced_remote_calls(source: Source) -> list[str]:
    if source.module == "cluster.clients":
        return []
    return [
        f"{source.module}:{node.lineno} calls .remote(); only cluster/clients.py does"
        for node in ast.walk(source.tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "remote"
    ]


def environment_reads(source: Source) -> list[str]:
    """Below level 4 the config decides, not the environment; setting a variable for a library is allowed."""
    if level_of(source.module) >= 4:
        return []
    setters = {
        id(node.value)
        for node in ast.walk(source.tree)
        if (isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Store))
        or (isinstance(node, ast.Attribute) and node.attr in {"setdefault", "update"})
    }
    return [
        f"{source.module}:{node.lineno} reads the environment"
        for node in ast.walk(source.tree)
        if isinstance(node, ast.Attribute)
        and ast.unparse(node) in {"os.environ", "os.getenv"}
        and id(node) not in setters
    ]


def future_annotations(source: Source) -> list[str]:
    names = imported_names(source)
    return [f"{source.module} imports {n}: it hides shapes" for n in names if n == "__future__.annotations"]


def oversize(source: Source) -> list[str]:
    num_lines = len(source.text.splitlines())
    allowed = LONGER_FILES.get(source.module, MAX_LINES)
    wrong = [f"{source.module} has {num_lines} lines, more than {allowed}"] if num_lines > allowed else []
    for node in ast.walk(source.tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = (node.end_lineno or node.lineno) - node.lineno + 1
            if length > MAX_FUNCTION_LINES:
                wrong.append(f"{source.module}.{node.name} has {length} lines, more than {MAX_FUNCTION_LINES}")
    return wrong


def vague_names(source: Source) -> list[str]:
    return [f"{source.module}: name the subject" for part in source.module.split(".") if part in VAGUE_NAMES]


@pytest.mark.parametrize(
    "rule",
    [
        upward_imports,
        misplaced_packages,
        unsafe_loading,
        misplaced_remote_calls,
        environment_reads,
        future_annotations,
        oversize,
        vague_names,
    ],
    ids=lambda rule: rule.__name__,
)
def test_package_has_no(rule: Callable[[Source], list[str]]) -> None:
    sources = package_sources()
    assert len(sources) > 3, f"found no package in {ROOT}"
    wrong = [line for source in sources for line in rule(source)]
    assert not wrong, "\n" + "\n".join(wrong)


def test_package_init_files_hold_only_a_docstring() -> None:
    for path in ROOT.rglob("__init__.py"):
        body = ast.parse(path.read_text(encoding="utf-8")).body
        code = [ast.unparse(n) for n in body if not (isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant))]
        if path.parent == ROOT:
            code = [line for line in code if not line.startswith("__version__ = ")]
        assert not code, f"{path.relative_to(ROOT)}: {code}"


@pytest.mark.parametrize(
    ("rule", "module", "text"),
    [
        (upward_imports, "nets.encoder", "from slotfilm_dist.policy import Policy"),
        (upward_imports, "nets.encoder", "from slotfilm_dist import policy"),
        (upward_imports, "nets.encoder", "def f():\n    import slotfilm_dist.policy"),
        (upward_imports, "envs.camera", "from slotfilm_dist.nets.encoder import Encoder"),
        (upward_imports, "learning.losses", "from slotfilm_dist.learning.sac import update"),
        (upward_imports, "rollout", "from slotfilm_dist.evaluation.record import record"),
        (misplaced_packages, "local", "def f():\n    import ray"),
        (misplaced_packages, "tuning.report", "import mani_skill.envs"),
        (misplaced_packages, "bench.render", "import mani_skill.envs"),
        (misplaced_packages, "doctor", "from sapien.render import RenderSystem"),
        (misplaced_packages, "replay.ring", "import torch"),
        (misplaced_packages, "config", "import torch"),
        (unsafe_loading, "runs", "import pickle"),
        (unsafe_loading, "runs", "from cloudpickle import loads"),
        (unsafe_loading, "runs", "torch.load(path)"),
        (unsafe_loading, "runs", "np.load(path, allow_pickle=True)"),
        (misplaced_remote_calls, "cluster.system", "actor.step.remote(1)"),
        (environment_reads, "rollout", "import os\nx = os.environ['HOME']"),
        (environment_reads, "rollout", "import os\nx = os.getenv('HOME')"),
        (future_annotations, "config", "from __future__ import annotations"),
        (oversize, "metrics", "x = 1\n" * (MAX_LINES + 1)),
        (oversize, "metrics", "def f():\n" + "    x = 1\n" * MAX_FUNCTION_LINES),
        (vague_names, "nets.utils", ""),
    ],
)
def test_rule_catches(rule: Callable[[Source], list[str]], module: str, text: str) -> None:
    assert len(rule(Source(module, text))) == 1


@pytest.mark.parametrize(
    ("rule", "module", "text"),
    [
        (upward_imports, "learning.sac", "from slotfilm_dist.learning.losses import critic_loss"),
        (upward_imports, "contracts", "from slotfilm_dist.messages import Observation"),
        (upward_imports, "runs", "from slotfilm_dist import __version__"),
        (misplaced_packages, "cluster.actors", "import ray.util"),
        (misplaced_packages, "bench.peers.rllib_training", "import ray"),
        (misplaced_packages, "envs.scene", "def f():\n    import sapien"),
        (unsafe_loading, "nets.backbone", "torch.load(path, weights_only=True)"),
        (unsafe_loading, "nets.backbone", "from pickle import UnpicklingError"),  # what torch.load raises on refusal
        (misplaced_remote_calls, "cluster.clients", "actor.step.remote(1)"),
        (environment_reads, "envs.camera", "import os\nos.environ['LP_NUM_THREADS'] = '0'"),
        (environment_reads, "doctor", "import os\nx = os.environ['HOME']"),
    ],
)
def test_rule_allows(rule: Callable[[Source], list[str]], module: str, text: str) -> None:
    assert rule(Source(module, text)) == []


def test_help_imports_neither_torch_nor_ray() -> None:
    child = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", PACKAGE, "--help"],
        cwd=ROOT.parent,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert child.returncode == 0, child.stderr
    imported = {line.rsplit("|", 1)[-1].strip().split(".")[0] for line in child.stderr.splitlines() if "|" in line}
    assert PACKAGE in imported, "the child reported no imports"
    assert not imported & {"torch", "ray", "mani_skill", "sapien"}
