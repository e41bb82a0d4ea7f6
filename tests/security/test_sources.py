"""What the source must never do: run what it reads, hand words to a shell, listen to the whole network."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PICKLES = {"pickle", "cPickle", "_pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal", "jsonpickle"}
FORBIDDEN_CALLS = {
    **dict.fromkeys(("eval", "exec", "compile", "__import__"), "runs text as code"),
    **dict.fromkeys(("yaml.load", "yaml.unsafe_load", "yaml.full_load"), "builds any object; use yaml.safe_load"),
    **dict.fromkeys(("torch.jit.load", "torch.hub.load", "torch.package.PackageImporter"), "runs what it loads"),
    **dict.fromkeys(("pd.read_pickle", "pandas.read_pickle", "np.lib.format.read_array"), "unpickles"),
    **dict.fromkeys(("os.system", "os.popen", "subprocess.getoutput", "tempfile.mktemp"), "opens a way for others"),
    "ssl._create_unverified_context": "trusts everybody",
}
GUARDED_CALLS = {"torch.export.load": ("slotfilm_dist/deploy/loader.py", "check_archive")}
"""Calls that one file may make, and what it must call before."""
EVERYWHERE = {"0.0.0.0", "::"}


def sources() -> list[tuple[str, str]]:
    folders = [ROOT / name for name in ("slotfilm_dist", "jobs", "ops") if (ROOT / name).is_dir()]
    paths = sorted(path for folder in folders for path in folder.rglob("*.py"))
    return [(path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")) for path in paths]


def offences(name: str, text: str) -> Iterator[str]:
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (f"{name} imports {a.name}" for a in node.names if a.name.split(".")[0] in PICKLES)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in PICKLES:
            # The one name that is an error and not a reader.
            yield from (f"{name} imports {node.module}.{a.name}" for a in node.names if a.name != "UnpicklingError")
        elif isinstance(node, ast.Constant) and node.value in EVERYWHERE:
            yield f"{name}:{node.lineno} names every interface of the machine"
        elif isinstance(node, ast.Call):
            yield from call_offences(name, node, text)


def call_offences(name: str, node: ast.Call, text: str) -> Iterator[str]:
    called = ast.unparse(node.func)
    given = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
    where = f"{name}:{node.lineno} {called}"
    if called in FORBIDDEN_CALLS:
        yield f"{where}: {FORBIDDEN_CALLS[called]}"
    if called in GUARDED_CALLS:
        home, guard = GUARDED_CALLS[called]
        before = text.splitlines()[: node.lineno - 1]
        if name != home or not any(line.strip().startswith(f"{guard}(") for line in before):
            yield f"{where}: only in {home}, after {guard}"
    if called == "torch.load" and given.get("weights_only") != "True":
        yield f"{where}: without weights_only=True"
    if called in ("np.load", "numpy.load") and given.get("allow_pickle") != "False":
        yield f"{where}: without allow_pickle=False"
    if given.get("allow_pickle", "False") != "False":
        yield f"{where}: allows pickle"
    if given.get("shell", "False") != "False":
        yield f"{where}: hands words to a shell"
    if given.get("verify") == "False" and called.startswith(("requests.", "httpx.")):
        yield f"{where}: trusts everybody"


def test_no_source_runs_what_it_reads_or_listens_everywhere() -> None:
    found = sources()
    assert len(found) > 50
    wrong = [line for name, text in found for line in offences(name, text)]
    assert not wrong, "\n" + "\n".join(wrong)


@pytest.mark.parametrize(
    "text",
    [
        "import pickle",
        "from cloudpickle import loads",
        "def f():\n    import dill",
        "eval(word)",
        "exec(compile(word, '', 'exec'))",
        "yaml.load(file)",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "torch.export.load(path)",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "read(path, allow_pickle=True)",
        "subprocess.run(words, shell=True)",
        "os.system(word)",
        "server.bind(('0.0.0.0', 80))",
        "requests.get(url, verify=False)",
    ],
)
def test_each_rule_catches(text: str) -> None:
    assert list(offences("slotfilm_dist/x.py", text))


def test_guarded_call_needs_its_guard_before_it() -> None:
    home, guard = GUARDED_CALLS["torch.export.load"]
    assert not list(offences(home, f"{guard}(path)\ntorch.export.load(path)"))
    assert list(offences(home, f"torch.export.load(path)\n{guard}(path)"))
