"""The phases of a run, driven on a backend that only counts."""

import io
import json
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filelock import FileLock
from rich.console import Console

from slotfilm_dist.backend import IsDue, Player, TrainReport, never_due
from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import load_config
from slotfilm_dist.envs.reward import NUM_INPUTS, TERMS
from slotfilm_dist.messages import EpisodeSummary, TransitionBlock
from slotfilm_dist.pipeline import Pipeline
from slotfilm_dist.presets import smoke
from slotfilm_dist.progress import Progress
from slotfilm_dist.replay.dataset import open_dataset
from slotfilm_dist.runs import RunDirectory
from slotfilm_dist.stopping import Interrupted, StopFlag
from slotfilm_dist.variants import apply_variant


def episode(seed: int = 0, episode_return: float = 1.0) -> EpisodeSummary:
    return EpisodeSummary(
        seed=seed,
        length=40,
        episode_return=episode_return,
        success_once=True,
        success_at_end=False,
        placed_at_end=False,
        grasped_once=False,
        reward_terms=(episode_return,),
    )


class CountingBackend:
    """Implements `Backend`: takes 40 steps a report, and notes what it is asked for."""

    action_dim = 7
    reward_term_names: tuple[str, ...] = ("all",)

    def __init__(self, config: RunConfig, during_play: Callable[[], None] | None = None) -> None:
        self.config = config
        self.calls: list[str] = []
        self.saved: list[dict[str, Any]] = []
        self.env_steps = config.schedule.random_steps
        self.unsettled_until = 0
        self._during_play = during_play

    def prepare(self) -> None:
        self.calls.append("prepare")

    def load_agent(self, checkpoints: Path) -> int:
        self.calls.append("load agent")
        return self.env_steps

    def random_blocks(self, num_steps: int, start: int) -> Iterator[TransitionBlock]:
        self.calls.append(f"random {start}+{num_steps}")
        for sequence in range(num_steps // 40):
            rows = 41
            is_step = np.arange(rows) < 40
            yield TransitionBlock(
                worker_id=0,
                incarnation=start,
                sequence=sequence,
                policy_version=-1,
                backbone_hash="",
                visual=np.zeros((rows, 0), np.uint8),
                proprio=np.zeros((rows, 35), np.float32),
                goal=np.zeros((rows, 3), np.float32),
                uv=np.zeros((rows, 2, 2), np.float32),
                visible=np.zeros((rows, 2), bool),
                action=np.zeros((rows, 7), np.float32),
                reward=np.zeros(rows, np.float32),
                terminated=np.zeros(rows, bool),
                truncated=np.arange(rows) == 39,
                is_step=is_step,
                episodes=(episode(sequence),),
            )

    def pretrain(self, dataset: Path, artifact: Path) -> Iterator[dict[str, float]]:
        raise AssertionError("an agent without a camera is not pre-trained")

    def begin_training(self, dataset: Path, pretrained: Path | None, resume_from: Path | None) -> dict[str, Any]:
        self.calls.append("begin" if resume_from is None else "resume")
        return {}

    def train(self, should_stop: Callable[[], bool], is_due: IsDue = never_due) -> Iterator[TrainReport]:
        while self.env_steps < self.config.schedule.total_steps and not should_stop():
            self.env_steps += 40
            self.calls.append(f"train {self.env_steps}")
            yield self._report()
        yield self._report()

    def _report(self) -> TrainReport:
        settled = self.env_steps >= self.unsettled_until
        return TrainReport(env_steps=self.env_steps, updates=self.env_steps, metrics={}, settled=settled)

    def play(self, player: Player, seeds: Sequence[int], should_stop: Callable[[], bool]) -> Iterator[EpisodeSummary]:
        self.calls.append(f"play {player} {seeds[0]}+{len(seeds)}")
        for seed in seeds:
            if self._during_play:
                self._during_play()
            yield episode(seed)

    def record(self, player: Player, seed: int, video: Path, film_strip: Path) -> EpisodeSummary:
        raise AssertionError("an agent without a camera is not filmed")

    def save(self, folder: Path, values: Mapping[str, Any], *, with_replay: bool, best: bool = False) -> int:
        name = "best" if best else f"updates-{self.env_steps:09d}"
        (folder / name).mkdir(parents=True, exist_ok=True)
        self.saved.append({"name": name, "with_replay": with_replay, **values})
        return 1

    def close(self) -> None:
        pass


def config_of(every_steps: int = 0) -> RunConfig:
    config = apply_variant("state_only", smoke())
    return replace(config, evaluation=replace(config.evaluation, every_steps=every_steps))


def execute(
    path: Path, backend: CountingBackend, stop: StopFlag | None = None, progress: Progress | None = None
) -> Path:
    progress = progress or Progress(Console(file=io.StringIO()))
    with RunDirectory(path / "run", backend.config) as run:
        return Pipeline(run, backend, path / "artifacts", progress, stop or StopFlag()).execute()


def test_phases_come_in_order_and_leave_a_report(tmp_path: Path) -> None:
    backend = CountingBackend(config_of())
    page = execute(tmp_path, backend)
    assert backend.calls == [
        "random 0+160",
        "begin",
        *(f"train {steps}" for steps in range(200, 401, 40)),
        "play random 10000000+2",
        "play agent 10000000+2",
    ]
    assert page.is_file()
    assert (tmp_path / "run" / "evaluation" / "final.json").is_file()
    assert (
        RunDirectory(tmp_path / "run", load_config(tmp_path / "run" / "config.json")).read_status()["phase"] == "done"
    )


def test_second_run_takes_the_data_that_are_there_and_a_finished_run_only_evaluates(tmp_path: Path) -> None:
    execute(tmp_path, CountingBackend(config_of()))
    again = CountingBackend(config_of())
    execute(tmp_path, again)
    assert again.calls == ["load agent", "play random 10000000+2", "play agent 10000000+2"]


def test_finished_run_with_a_larger_budget_trains_on_before_it_is_evaluated(tmp_path: Path) -> None:
    execute(tmp_path, CountingBackend(config_of()))
    longer = config_of()
    longer = replace(longer, schedule=replace(longer.schedule, total_steps=480))
    again = CountingBackend(longer)
    again.env_steps = 400
    said = io.StringIO()
    execute(tmp_path, again, progress=Progress(Console(file=said, width=400)))
    assert again.calls == ["resume", "train 440", "train 480", "play random 10000000+2", "play agent 10000000+2"]
    assert "goes on at 400 of now 480 steps" in said.getvalue()
    final = json.loads((tmp_path / "run" / "evaluation" / "final.json").read_text())
    assert final["env_steps"] == 480


class OtherRun(Progress):
    """Another run, which does its own part as soon as this one says that it waits."""

    def __init__(self, act: Callable[[], None]) -> None:
        super().__init__(Console(file=io.StringIO()))
        self._act = act
        self.waited = 0

    def say(self, text: str) -> None:
        if "another run is making random-" in text:
            self.waited += 1
            self._act()


def test_run_waits_for_the_data_that_another_run_is_making_and_takes_them(tmp_path: Path) -> None:
    execute(tmp_path / "other", CountingBackend(config_of()))
    (made,) = (tmp_path / "other" / "artifacts").glob("random-*")
    artifacts = tmp_path / "artifacts"
    artifacts.mkdir()
    lock = FileLock(artifacts / f".{made.name}.lock")

    def finish() -> None:
        made.rename(artifacts / made.name)
        lock.release()

    backend, other = CountingBackend(config_of()), OtherRun(finish)
    lock.acquire()
    execute(tmp_path, backend, progress=other)
    assert other.waited == 1
    assert backend.calls[0] == "begin"


def test_stop_ends_the_wait_for_another_run(tmp_path: Path) -> None:
    execute(tmp_path / "other", CountingBackend(config_of()))
    (made,) = (tmp_path / "other" / "artifacts").glob("random-*")
    (tmp_path / "artifacts").mkdir()
    stop = StopFlag()

    def interrupt() -> None:
        stop.signal_number = int(signal.SIGTERM)

    with FileLock(tmp_path / "artifacts" / f".{made.name}.lock"), pytest.raises(Interrupted, match="SIGTERM"):
        execute(tmp_path, CountingBackend(config_of()), stop, OtherRun(interrupt))


def test_data_that_are_there_need_no_lock(tmp_path: Path) -> None:
    execute(tmp_path, CountingBackend(config_of()))
    (made,) = (tmp_path / "artifacts").glob("random-*")
    other = OtherRun(lambda: None)
    with FileLock(tmp_path / "artifacts" / f".{made.name}.lock"):
        execute(tmp_path, CountingBackend(config_of()), progress=other)
    assert other.waited == 0


class PaperRewardBackend(CountingBackend):
    """Steps of an environment with the paper's reward: the inputs of step i are i."""

    reward_term_names = TERMS

    def random_blocks(self, num_steps: int, start: int) -> Iterator[TransitionBlock]:
        for block in super().random_blocks(num_steps, start):
            inputs = np.repeat(np.arange(block.num_rows, dtype=np.float32)[:, None], NUM_INPUTS, axis=1)
            yield replace(block, reward_inputs=inputs, episodes=())


def test_data_of_the_papers_reward_hold_its_inputs_and_others_the_reward(tmp_path: Path) -> None:
    for name, kind in (("paper", PaperRewardBackend), ("own", CountingBackend)):
        backend = kind(config_of())
        backend.play = CountingBackend(config_of()).play
        with RunDirectory(tmp_path / name, backend.config) as run:
            quiet = Progress(Console(file=io.StringIO()))
            Pipeline(run, backend, tmp_path / f"artifacts-{name}", quiet, StopFlag()).make_artifacts(encoder=False)
    (paper,) = (tmp_path / "artifacts-paper").glob("random-*")
    (own,) = (tmp_path / "artifacts-own").glob("random-*")
    inputs = open_dataset(paper, paper.name.removeprefix("random-")).reward_inputs
    assert inputs is not None
    assert inputs[:41, 0].tolist() == list(range(41))
    assert open_dataset(own, own.name.removeprefix("random-")).reward_inputs is None


def test_evaluations_during_training_come_on_time_and_keep_the_best(tmp_path: Path) -> None:
    backend = CountingBackend(config_of(every_steps=100))
    execute(tmp_path, backend)
    during = [i for i, call in enumerate(backend.calls) if call == "play agent 11000000+5"]
    assert [backend.calls[i - 1] for i in during] == ["train 280", "train 360"]
    assert [saved["name"] for saved in backend.saved].count("best") == 1, "the second is no better"


def test_evaluations_during_training_wait_for_a_report_that_is_settled(tmp_path: Path) -> None:
    backend = CountingBackend(config_of(every_steps=100))
    backend.unsettled_until = 320
    execute(tmp_path, backend)
    during = [i for i, call in enumerate(backend.calls) if call == "play agent 11000000+5"]
    assert [backend.calls[i - 1] for i in during] == ["train 320", "train 360"]


def test_signal_during_training_saves_everything_and_says_so(tmp_path: Path) -> None:
    backend, stop = CountingBackend(config_of()), StopFlag()
    stop.signal_number = 0
    train = backend.train

    def stopped_after_two(should_stop: Callable[[], bool], is_due: IsDue = never_due) -> Iterator[TrainReport]:
        for count, report in enumerate(train(should_stop), start=1):
            if count == 2:
                stop.signal_number = int(signal.SIGINT)
            yield report

    backend.train = stopped_after_two
    with pytest.raises(Interrupted, match="stopped by SIGINT") as interruption:
        execute(tmp_path, backend, stop)
    assert interruption.value.exit_code == 130
    assert backend.saved[-1]["with_replay"]
    assert backend.saved[-1]["env_steps"] == backend.env_steps == 240


def test_signal_during_an_evaluation_in_training_loses_no_update(tmp_path: Path) -> None:
    stop = StopFlag()

    def interrupt() -> None:
        stop.signal_number = int(signal.SIGTERM)

    backend = CountingBackend(config_of(every_steps=100), during_play=interrupt)
    with pytest.raises(Interrupted, match="SIGTERM"):
        execute(tmp_path, backend, stop)
    assert backend.saved[-1]["env_steps"] == backend.env_steps == 280
    assert backend.saved[-1]["with_replay"]
    assert backend.saved[-1]["next_evaluation"] == 260
    resumed = CountingBackend(config_of(every_steps=100))
    resumed.env_steps = 280
    execute(tmp_path, resumed)
    assert resumed.calls[0] == "resume"


def test_first_signal_is_remembered_the_second_ends_at_once_and_handlers_come_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    stop = StopFlag()
    with stop.listening():
        assert not stop()
        signal.raise_signal(signal.SIGINT)
        assert stop()
        with pytest.raises(Interrupted, match="SIGINT"):
            stop.check()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
