"""A run from nothing to its report: collect, pre-train, train, evaluate. The same for every backend."""

import contextlib
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from slotfilm_dist.artifacts import sole_maker
from slotfilm_dist.backend import Backend, EvaluationFailedError, Player, RunFailedError, TrainReport
from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.reward import num_reward_inputs
from slotfilm_dist.episodes import episode_metrics
from slotfilm_dist.evaluation.page import write_page
from slotfilm_dist.evaluation.record import AGENT, Evaluation, save_evaluation, summarize
from slotfilm_dist.learning.checkpoint import CheckpointStore
from slotfilm_dist.learning.learner import dataset_hash, dataset_schema, pretrain_hash
from slotfilm_dist.messages import EpisodeSummary, TrainingEpisode
from slotfilm_dist.metrics import phase_index
from slotfilm_dist.progress import Phase, Progress
from slotfilm_dist.replay.dataset import MANIFEST, open_dataset
from slotfilm_dist.replay.dataset_writer import FrameDatasetWriter
from slotfilm_dist.run_sinks import open_sinks
from slotfilm_dist.runs import RunDirectory
from slotfilm_dist.saving import Saver
from slotfilm_dist.sinks import FanOut
from slotfilm_dist.stopping import Interrupted, StopFlag

RECENT_EPISODES = 20
"""Episodes that the shown return is averaged over."""
DURING_SEEDS = 1_000_000
"""Distance of the seeds of evaluations during training from those of the final one."""
POLICY_NAMES: dict[Player, str] = {"random": "random", "expert": "scripted expert", "agent": AGENT}


class Pipeline:
    """Drives one run through its phases; each phase that is already done is skipped.

    Args:
        run: the entered run directory.
        backend: where the roles live.
        artifacts: folder of data and encoders that runs share.
        progress: tells the user.
        stop: asked between pieces of work.
    """

    def __init__(
        self, run: RunDirectory, backend: Backend, artifacts: Path, progress: Progress, stop: StopFlag
    ) -> None:
        self._run = run
        self._config: RunConfig = run.config
        self._backend = backend
        self._artifacts = artifacts
        self._progress = progress
        self._stop = stop
        self._status = run.read_status()
        self._sink = FanOut(open_sinks(run))
        self._began = time.monotonic() - float(self._status.get("time_s", 0.0))
        self._best, self._trained_steps = float("-inf"), 0
        self._returns: deque[float] = deque(maxlen=RECENT_EPISODES)
        self._solved: deque[bool] = deque(maxlen=RECENT_EPISODES)
        self._num_played = 0
        self._played_s = 0.0

    def execute(self) -> Path:
        """Do what is left to do; gives the report's path.

        Raises:
            Interrupted: a signal came; the run can be resumed.
        """
        try:
            dataset = self._collect()
            pretrained = self._pretrain(dataset)
            self._train(dataset, pretrained)
            self._evaluate()
        finally:
            self._sink.close()
        return write_page(self._run.path)

    def make_artifacts(self, *, encoder: bool) -> None:
        """Make the random policy's data and, where asked for, the pre-trained encoder, unless they are there.

        Raises:
            Interrupted: a stop was asked for; what was made so far is kept and gone on with.
        """
        try:
            dataset = self._collect()
            if encoder:
                self._pretrain(dataset)
        finally:
            self._sink.close()

    def _collect(self) -> Path:
        """The random policy's data, from the artifacts where they are there."""
        folder = self._artifacts / f"random-{dataset_hash(self._config)}"
        if not (folder / MANIFEST).exists():
            with sole_maker(folder, self._progress, self._stop):
                if not (folder / MANIFEST).exists():
                    self._make_dataset(folder)
                    return folder
        self._progress.say(f" collect  random-policy data is there: {folder}")
        return folder

    def _make_dataset(self, folder: Path) -> None:
        config = self._config
        wanted = config.schedule.random_steps
        self._progress.begin("collect", f"{wanted} steps of the random policy")
        inputs = num_reward_inputs(self._backend.reward_term_names)
        schema = dataset_schema(config, self._backend.action_dim, inputs)
        started = time.monotonic()
        with FrameDatasetWriter(folder, schema, dataset_hash(config)) as writer:
            already = writer.num_steps
            for block in self._backend.random_blocks(wanted - already, already) if already < wanted else ():
                writer.append(block)
                where = {"policy_version": -1, "env_steps": writer.num_steps}
                self._note_episodes([TrainingEpisode(summary=episode, **where) for episode in block.episodes])
                rate = (writer.num_steps - already) / (time.monotonic() - started)
                self._progress.show(writer.num_steps, wanted, {"steps/s": f"{rate:.0f}"})
                self._write("collect", writer.num_steps, 0, {"worker_env_steps_per_s": rate})
                self._stop.check()
            writer.finish()
            self._progress.end(f"{writer.num_steps} steps")

    def _pretrain(self, dataset: Path) -> Path | None:
        config = self._config
        if not config.pretrains:
            return None
        folder = self._artifacts / f"encoder-{pretrain_hash(config)}"
        if not folder.exists():
            with sole_maker(folder, self._progress, self._stop):
                if not folder.exists():
                    self._make_encoder(dataset, folder)
                    return folder
        self._progress.say(f"pretrain  the pre-trained encoder is there: {folder}")
        return folder

    def _make_encoder(self, dataset: Path, folder: Path) -> None:
        config = self._config
        total = config.pretrain.steps
        num_steps = open_dataset(dataset, dataset_hash(config), verify=False).num_steps
        self._progress.begin("pretrain", f"{total} gradient steps: positions, visibility, attention")
        shown: dict[str, float] = {}
        for metrics in self._backend.pretrain(dataset, folder):
            shown |= metrics
            self._progress.show(shown["pretrain_steps_total"], total, _pretrain_line(shown))
            self._write("pretrain", num_steps, 0, metrics)
            self._stop.check()
        error, baseline = shown.get("pretrain_position_error_px"), shown.get("pretrain_baseline_error_px")
        self._progress.end(
            f"held-out position error {error:.1f} px, predicting the mean {baseline:.1f} px"
            if error is not None and baseline is not None
            else "done"
        )

    def _train(self, dataset: Path, pretrained: Path | None) -> None:
        config = self._config
        total = config.schedule.total_steps
        if self._status.get("trained"):
            trained = int(self._status.get("env_steps", total))
            if trained >= total:
                self._trained_steps = trained
                self._backend.load_agent(self._run.checkpoints)
                return
            self._progress.say(
                f"   train  goes on at {trained} of now {total} steps; of a run that was over, replay holds only what "
                "had been saved on the way, or the random policy's data: expect the return to dip first"
            )
        self._progress.begin("train", f"{config.variant}: {total} environment steps in all")
        resumed = self._run.checkpoints if any(self._run.checkpoints.glob("updates-*")) else None
        values = self._backend.begin_training(dataset, pretrained, resumed)
        # A run that goes on from an older checkpoint may have written a better `best` since.
        best = CheckpointStore(self._run.checkpoints, config.checkpoint.keep).best_values()
        self._best = max(float(known.get("best_return", float("-inf"))) for known in (values, best))
        next_evaluation = int(
            values.get("next_evaluation", config.schedule.random_steps + config.evaluation.every_steps)
        )
        self._saver = Saver(
            self._backend, self._run.checkpoints, config.checkpoint.every_updates, int(values.get("updates", 0))
        )
        report = TrainReport(env_steps=0, updates=0, metrics={})

        def evaluation_due(env_steps: int) -> bool:
            return bool(config.evaluation.every_steps) and next_evaluation <= env_steps < total

        def is_due(env_steps: int, updates: int) -> bool:
            return evaluation_due(env_steps) or self._saver.due(updates)

        for report in self._backend.train(self._stop, is_due):
            self._note(report)
            if report.settled and evaluation_due(report.env_steps) and not self._stop():
                # A signal only breaks the evaluation off: training then stops by itself where its episode ends.
                with contextlib.suppress(Interrupted):
                    self._evaluate_now(report)
                    while next_evaluation <= report.env_steps:
                        next_evaluation += config.evaluation.every_steps
            if report.settled and self._saver.due(report.updates):
                self._save(report, next_evaluation, with_replay=False)
        self._trained_steps = report.env_steps
        done = report.env_steps >= total
        problem = self._save(
            report, next_evaluation, with_replay=config.checkpoint.save_replay and not done, trained=done
        )
        if problem:
            raise RunFailedError(f"the last checkpoint could not be written: {problem}; make room, then --resume")
        self._progress.end(f"{report.env_steps} steps, {report.updates} updates")
        self._stop.check()

    def _evaluate_now(self, report: TrainReport) -> None:
        # Other episodes than the final ones: which checkpoint is the best must not be chosen by those it is judged by.
        seeds = self._seeds(self._config.evaluation.during_episodes, DURING_SEEDS)
        try:
            result = self._play(f"step-{report.env_steps}", "agent", seeds, report.env_steps)
        except EvaluationFailedError as error:
            self._progress.say(f"   train  goes on without this evaluation: {error}")
            return
        self._write("train", report.env_steps, report.updates, self._evaluation_metrics(result))
        if result.mean_return > self._best:
            values = {"best_return": result.mean_return}
            metrics, problem = self._saver.save(report, values, with_replay=False, best=True)
            self._best = self._best if problem else result.mean_return
            self._tell_save(report, metrics, problem)

    def _save(self, report: TrainReport, next_evaluation: int, *, with_replay: bool, trained: bool = False) -> str:
        """Write a checkpoint; gives why it could not be written, empty if it was."""
        values = {"next_evaluation": next_evaluation, "best_return": self._best, "env_steps": report.env_steps}
        metrics, problem = self._saver.save(report, values, with_replay=with_replay)
        self._tell_save(report, metrics, problem)
        if not problem:
            place = {"env_steps": report.env_steps, "updates": report.updates}
            try:
                self._run.write_status(phase="train", trained=trained, time_s=self._time_s(), **place)
            except OSError as error:
                return str(error) if trained else ""  # the checkpoint is there, and the next one tells its place
        return problem

    def _tell_save(self, report: TrainReport, metrics: Mapping[str, float], problem: str) -> None:
        self._write("train", report.env_steps, report.updates, metrics)
        if problem:
            self._progress.say(f"   train  a checkpoint could not be written, the one before stays: {problem}")

    def _evaluate(self) -> None:
        config, trained = self._config, self._trained_steps
        seeds = self._seeds(config.evaluation.episodes)
        self._write("evaluate", trained, None, self._run.room())
        self._progress.begin("evaluate", f"{len(seeds)} episodes each: the random policy, the trained agent")
        random = self._play("random", "random", seeds, 0)
        final = self._play("final", "agent", seeds, trained)
        self._write("evaluate", trained, None, self._evaluation_metrics(final))
        if config.encoder.uses_image:
            for seed in seeds[: config.evaluation.videos]:
                self._backend.record(
                    "agent",
                    seed,
                    self._run.path / "videos" / f"agent-{seed}.mp4",
                    self._run.path / "videos" / f"agent-{seed}.png",
                )
                self._stop.check()
        low, high = final.success_interval
        self._progress.end(
            f"return {final.mean_return:.1f} against {random.mean_return:.1f} at random on the same seeds; "
            f"success {final.success_rate:.0%} [{low:.0%}, {high:.0%}]"
        )
        self._run.write_status(phase="done", env_steps=trained, trained=True, time_s=self._time_s())

    def _play(self, name: str, player: Player, seeds: list[int], env_steps: int) -> Evaluation:
        episodes: list[EpisodeSummary] = []
        began = time.monotonic()
        for episode in self._backend.play(player, seeds, self._stop):
            episodes.append(episode)
            self._num_played += 1
            mean = np.mean([e.episode_return for e in episodes])
            self._progress.show(len(episodes), len(seeds), {"policy": player, "return": f"{mean:.1f}"})
            self._stop.check()
        self._stop.check()
        result = summarize(name, POLICY_NAMES[player], env_steps, tuple(episodes), self._backend.reward_term_names)
        try:
            save_evaluation(result, self._run.path)
        except OSError as error:
            raise EvaluationFailedError(f"{name} could not be written: {error}; make room, then --resume") from error
        self._played_s = time.monotonic() - began
        return result

    def _seeds(self, count: int, offset: int = 0) -> list[int]:
        first = self._config.evaluation.seed + offset
        return list(range(first, first + count))

    def _evaluation_metrics(self, result: Evaluation) -> dict[str, float]:
        return {
            "eval_return": result.mean_return,
            "eval_return_scaled": result.mean_return * self._config.sac.reward_scale,
            "eval_return_std": result.std_return,
            "eval_success_rate": result.success_rate,
            "eval_success_once_rate": float(np.mean([e.success_once for e in result.episodes])),
            "eval_duration_s": self._played_s,
            "eval_episodes_total": float(self._num_played),
        }

    def _note(self, report: TrainReport) -> None:
        """Write a report's numbers and show them."""
        self._note_episodes(report.episodes)
        own = self._saver.age(report) | self._run.room() | self._eta(report)
        self._write("train", report.env_steps, report.updates, dict(report.metrics) | own)
        values = {
            "steps/s": f"{report.metrics.get('worker_env_steps_per_s', 0):.0f}",
            "updates/s": f"{report.metrics.get('learner_updates_per_s', 0):.0f}",
        }
        if self._returns:
            values |= {"return": f"{np.mean(self._returns):.1f}", "success": f"{np.mean(self._solved):.0%}"}
        self._progress.show(report.env_steps, self._config.schedule.total_steps, values)

    def _note_episodes(self, episodes: Sequence[TrainingEpisode]) -> None:
        if not episodes:
            return
        self._run.log_episodes(episodes)
        summaries = [episode.summary for episode in episodes]
        self._returns.extend(summary.episode_return for summary in summaries)
        self._solved.extend(summary.success_at_end for summary in summaries)
        metrics = episode_metrics(summaries, self._backend.reward_term_names, self._config.sac.reward_scale)
        last = episodes[-1]
        self._write("train" if last.policy_version >= 0 else "collect", last.env_steps, None, metrics)

    def _write(self, phase: Phase, env_steps: int, updates: int | None, values: Mapping[str, float]) -> None:
        axes = {"time_s": self._time_s(), "env_steps": env_steps, "phase": phase_index(phase)}
        if updates is not None:
            axes["updates"] = updates
        self._sink.write(axes | dict(values))

    def _eta(self, report: TrainReport) -> dict[str, float]:
        """Time to the last step at the present rate; nothing while nobody collects."""
        rate = report.metrics.get("worker_env_steps_per_s", 0.0)
        left = max(0, self._config.schedule.total_steps - report.env_steps)
        return {"run_eta_s": left / rate} if rate > 0 else {}

    def _time_s(self) -> float:
        return time.monotonic() - self._began


def _pretrain_line(metrics: Mapping[str, float]) -> dict[str, str]:
    line = {
        "steps/s": f"{metrics.get('pretrain_steps_per_s', 0):.1f}",
        "position": f"{metrics.get('pretrain_position_loss', 0):.4f}",
        "visibility": f"{metrics.get('pretrain_visibility_loss', 0):.3f}",
        "attention": f"{metrics.get('pretrain_attention_loss', 0):.3f}",
    }
    if "pretrain_position_error_px" in metrics:
        line["error"] = f"{metrics['pretrain_position_error_px']:.1f} px"
    return line
