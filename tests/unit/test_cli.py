"""The command line's refusals: one sentence, exit code 2, nothing written or changed."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from slotfilm_dist.__main__ import COMMANDS, main
from slotfilm_dist.commands.options import build_config
from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import save_config
from slotfilm_dist.presets import smoke
from slotfilm_dist.runs import RunDirectory
from slotfilm_dist.variants import apply_variant


def refusal(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The sentence on standard error of a command that refuses."""
    assert main(words) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("slotfilm: ")
    assert told.err.count("\n") == 1
    assert "Traceback" not in told.err
    return told.err


ON_STACKCUBE = ("--env.task", "StackCube-v1")
NO_WEIGHTS = ("--encoder.backbone", "path", "--encoder.backbone_path", "nothing.pt")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (("trian",), "did you mean 'train'"),
        (("train", "quik"), "did you mean 'quick'"),
        (("train", "--variant", "no_stat"), "did you mean 'no_state'"),
        (("train", "--env.task", "PickBanana"), "did you mean 'PickBanana-v1'"),
        (("grid", "quick", *ON_STACKCUBE, "--encoder.goal", "--dry-run"), "encoder.goal = True: StackCube-v1 has no"),
        (("grid", "quick", *ON_STACKCUBE, "--only", "varpi_1"), "varpi_1 (StackCube-v1 brings its own reward)"),
        (("grid", "quick", *ON_STACKCUBE, "--only", "slotfilm_goal"), "(StackCube-v1 has no goal point to query)"),
        (("train", "--sac.gama", "0.9"), "did you mean --sac.gamma"),
        (("train", "--sac.gamma", "2"), "sac.gamma"),
        (("train", "--sac.gamma", "high"), "sac.gamma"),
        (("train", "--sac.gamma"), "sac.gamma"),
        (("train", "--runtime.mode", "rya"), "runtime.mode"),
        (("train", "smoke", *NO_WEIGHTS), "'nothing.pt': there is no such file"),
        (("grid", "smoke", *NO_WEIGHTS), "'nothing.pt': there is no such file"),
        (("train", "quick", "--encoder.goal", "--encoder.fusion", "state_only"), "'state_only' has no slots"),
        (("train", "--encoder.goal", "--variant", "state_only"), "'state_only' always has encoder.goal = False"),
        (("train", "--variant", "varpi_1", "--reward.varpi", "2"), "'varpi_1' always has reward.varpi = 1.0"),
        (("train", "--variant", "cnn", "--pretrain.steps=7"), "'cnn' always has pretrain.steps = 0"),
        (("train", "--variant", "drqv2", "--lr.actor", "1e-3"), "its own fields are --ddpg.*"),
        (("train", *ON_STACKCUBE, "--variant", "alpha_5"), "StackCube-v1 brings its own reward; take another variant"),
        (("train", *ON_STACKCUBE, "--env.goal_visible"), "--env.goal_visible: StackCube-v1 brings its own reward and"),
        (("train", "quick", "--runtime.mode", "local", "--workers", "2"), "one process has no workers"),
        (("train", "quick", "--runtime.exact_resume"), "add --runtime.mode local"),
        (("train", "--variant", ""), "--variant: its value is missing; was it an empty variable"),
        (("train", "quick", "--variant="), "--variant: its value is missing; was it an empty variable"),
        (("report", ""), "was it an empty variable"),
        (("train", "quick", "--workers", "3", "--sac.gamma", "2"), "sac.gamma = 2.0"),
        (("train", "quick", "--checkpoint.no_save_replay", "--env.max_steps", "0"), "env.max_steps = 0"),
        (("grid", "quick", "--cpus-per-trial", "inf", "--dry-run"), "--cpus-per-trial inf: must be greater than 0"),
        (("watch", "run", "--every", "inf"), "--every inf"),
        (("scale", "run", "--workers", "2", "--timeout-s", "nan"), "--timeout-s nan"),
        (("train", "--obs.num_objects", "1"), "obs.num_objects = 1: PickBanana-v1 has 2"),
        (
            ("train", "quick", "--encoder.goal_out_of_view_bias", "10"),
            "_bias = 10.0: must be 0 or less",
        ),
        (("train", "quick", "extra"), "extra"),
        (("train", "smoke", "--workers", "many"), "--workers: many: must be 1 or more, or auto"),
        (("scale", "nowhere", "--workers", "0"), "--workers: 0: must be 1 or more, or auto"),
        (("scale", "nowhere", "--workers", "auto"), "nowhere has no cluster.json"),
        (("train", "--name", "a/b"), "--name"),
        (("train", "--resume", ""), "was it an empty variable"),
        (("train", "paper", "--resume", "run"), "leave a preset away"),
        (("train", "--resume", "run", "--runs", "elsewhere"), "leave --runs away"),
        (("train", "--encoder.pos_scale", "nan"), "encoder.pos_scale"),
        (("train", "--env.far_m", "inf"), "env.far_m"),
        (("train", "--sac.batch_size", "1" + 26 * "0"), "sac.batch_size"),
        (("train", "--evaluation.seed", "99999999999999"), "evaluation.seed"),
        (("grid", "quick", "--variant", "cnn", "--dry-run"), "`--only A,B` takes some"),
        (("grid", "quick", "--only", "", "--dry-run"), "was it an empty variable"),
        (("grid", "quick", "--seeds", "1000000000", "--dry-run"), "must be 10000 or fewer"),
        (("chaos", "--minutes", "nan", "port_taken"), "--minutes and --soak"),
        (("evaluate", "--policy", "random", "--seed", "5000000000"), "--seed 5000000000"),
        (("cost", "--only", "slotfilm,no_stat"), "did you mean 'no_state'"),
        (("train", "--sac.temperature", "0.1", "quick"), "the preset comes first"),
        (("train", "--resume", "nowhere"), "config.json does not exist"),
        (("evaluate",), "--policy expert"),
        (("evaluate", "nowhere"), "config.json does not exist"),
        (("evaluate", "--policy", "expret"), "expert"),
        (("evaluate", "--policy", "random", "--episodes", "0"), "--episodes 0"),
        (("evaluate", "--policy", "random", "--episodes", "many"), "many"),
        (("evaluate", "--what", "perception"), "give the directory of its run"),
        (("evaluate", "--what", "perceptoin"), "perceptoin"),
        (("evaluate", "nowhere", "--what", "robustness"), "config.json does not exist"),
        (("probe", "nowhere"), "config.json does not exist"),
        (("probe", "nowhere", "--episodes", "1"), "--episodes 1"),
        (("probe", "nowhere", "--seed", "-1"), "--seed -1"),
        (("evaluate", "nowhere", "--what", "film_strips", "--seed", "-1"), "--seed -1"),
        (("perceive", "a.png", "--checkpoint", "nowhere", "--json"), "config.json does not exist"),
        (("perceive", "a.png"), "--checkpoint"),
        (("report", "nowhere"), "nowhere"),
        (("report",), "run"),
        (("cost", "--only", "no_stat"), "did you mean 'no_state'"),
        (("variants", "--taks"), "--taks"),
    ],
)
def test_mistake_is_refused_in_one_sentence_before_anything_is_written(
    place: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], part: str
) -> None:
    assert part in refusal(capsys, *words)
    assert list(place.iterdir()) == []


@pytest.mark.parametrize(("variant", "field"), [("slotfilm_goal", ()), ("", ("--encoder.goal",))])
def test_goal_query_on_a_task_without_a_goal_is_refused(variant: str, field: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match=r"encoder\.goal = True: StackCube-v1 has no goal.*leave --encoder\.goal"):
        build_config("quick", variant, (*ON_STACKCUBE, *field))


def test_existing_run_and_corrupt_config_stay_as_they_are(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "runs" / "mine").mkdir(parents=True)
    (place / "runs" / "mine" / "config.json").write_text('{"sac": {"gamma"')
    before = contents(place)
    assert "exists; choose another --name" in refusal(capsys, "train", "--name", "mine")
    for command in (("train", "--resume"), ("evaluate",)):
        assert "config.json is not valid JSON" in refusal(capsys, *command, "runs/mine")
    assert contents(place) == before


def test_resuming_with_another_agent_is_refused(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "run").mkdir()
    save_config(smoke(), place / "run" / "config.json")
    before = contents(place)
    assert "sac.gamma cannot change" in refusal(capsys, "train", "--resume", "run", "--sac.gamma", "0.5")
    assert contents(place) == before


def test_folder_that_cannot_be_one_is_refused_before_anything_starts(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "file").write_text("mine")
    told = refusal(capsys, "train", "smoke", "--runtime.mode", "local", "--runs", "file")
    assert "is a file, not a folder" in told
    (place / "run" / "config.json").mkdir(parents=True)
    assert "config.json cannot be read" in refusal(capsys, "train", "--resume", "run")
    assert (place / "file").read_text() == "mine"


def test_picture_that_is_looked_at_is_not_overwritten(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "photo.png").write_bytes(b"mine")
    (place / "run").mkdir()
    save_config(smoke(), place / "run" / "config.json")
    words = ("perceive", "photo.png", "--checkpoint", "run", "--out", "./photo.png")
    assert "would overwrite what is looked at" in refusal(capsys, *words)
    assert (place / "photo.png").read_bytes() == b"mine"


def test_second_driver_of_a_run_is_refused(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config: RunConfig = replace(smoke(), runtime=replace(smoke().runtime, mode="local"))
    with RunDirectory(place / "run", config):
        before = contents(place)
        assert "is in use by process" in refusal(capsys, "train", "--resume", "run")
        assert contents(place) == before


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_command_has_help(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([name, "--help"])
    assert stop.value.code == 0
    assert f"usage: slotfilm {name}" in capsys.readouterr().out


def test_help_lists_every_command_and_imports_neither_torch_nor_ray() -> None:
    script = (
        "import sys; from slotfilm_dist.__main__ import main; main(['--help']); "
        "print(sorted({'torch', 'ray', 'mani_skill', 'sapien'} & set(sys.modules)))"
    )
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert told.splitlines()[-1] == "[]"
    assert all(f"\n  {name} " in told for name in COMMANDS)


def test_fields_are_listed_with_their_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["train", "smoke", "--fields"])
    assert stop.value.code in (0, None)
    assert "--sac.gamma" in capsys.readouterr().out


@pytest.mark.parametrize("variant", ["drqv2", "no_static", "cnn", "reward_scale_5", "oracle_state"])
def test_train_makes_of_variant_and_fields_what_a_grid_makes_of_them(variant: str) -> None:
    fields = ("--schedule.total_steps", "50000", "--schedule.random_steps", "10000", "--lr.critic_value", "3e-4")
    fields = ("--sac.reward_scale", "4", "--reward.weights.place", "3", *(fields if variant != "drqv2" else fields[:4]))
    expected = apply_variant(variant, build_config("laptop", "slotfilm", fields))
    assert build_config("laptop", variant, fields) == expected
    if variant == "drqv2":
        assert expected.ddpg.std_steps < expected.schedule.total_steps < 50_000, "noise and budget are scaled"


def test_what_only_a_variant_can_have_can_be_changed_with_it() -> None:
    assert build_config("quick", "drq", ("--sac.augment_views", "4")).sac.augment_views == 4
    assert build_config("quick", "cnn", ("--encoder.feature_dim", "64")).encoder.feature_dim == 64
    assert build_config("quick", "drqv2", ("--ddpg.std_steps", "9999")).ddpg.std_steps == 9999
