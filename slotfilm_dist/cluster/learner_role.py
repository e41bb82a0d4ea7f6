"""The learner on a cluster: pre-trains, begins and continues training, writes checkpoints. Plain, without Ray."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from slotfilm_dist.cluster.fair_lock import FairLock
from slotfilm_dist.cluster.learning_loops import LearningLoops, Publisher, SampleLink, UpdateLink
from slotfilm_dist.cluster.messages import AgentSetup, LearnerBeginning, LearnerStatus
from slotfilm_dist.config import RunConfig
from slotfilm_dist.learning.checkpoint import Checkpoint, CheckpointStore, read_checkpoint
from slotfilm_dist.learning.learner import Learner, dataset_hash, learning_hash
from slotfilm_dist.learning.pretraining_files import continue_unfinished, save_finished, save_unfinished
from slotfilm_dist.learning.recovery import Recovery
from slotfilm_dist.messages import WeightSnapshot
from slotfilm_dist.replay.dataset import FrameDataset, open_dataset


class LearnerRole:
    """Holds the learner; `start` begins the threads of `LearningLoops`, `stop` ends them.

    Args:
        config: the run.
        action_dim: size of an action.
        device: where it computes.
        hub: admits updates, takes weights.
    """

    def __init__(self, config: RunConfig, action_dim: int, device: torch.device, hub: UpdateLink) -> None:
        self._config, self._action_dim, self._device = config, action_dim, device
        self._hub = hub
        self._store: SampleLink | None = None
        self._learner: Learner | None = None
        self._publisher: Publisher | None = None
        self._recovery: Recovery | None = None
        self._loops: LearningLoops | None = None
        self._between_updates = FairLock()
        self._candidate: Checkpoint | None = None
        self._verified: set[Path] = set()

    def fetch_weights(self) -> None:
        """Find out whether the backbone's initial weights can be had; raises ``ValueError`` if not."""
        Learner(self._config, self._action_dim, torch.device("cpu"))

    def load_agent(self, checkpoints: Path) -> int:
        """Build the agent of a run's newest checkpoint and publish it; gives the steps it learned from.

        Raises:
            ValueError: there is no checkpoint that can be used.
        """
        found = CheckpointStore(checkpoints, self._config.checkpoint.keep).read_last(learning_hash(self._config))
        if found is None:
            raise ValueError(f"{checkpoints} holds no checkpoint; the run has not trained yet")
        learner = self._learner = Learner(self._config, self._action_dim, self._device, fetch_weights=False)
        learner.load_checkpoint(found[0])
        self._introduce()
        return int(found[0].values["limiter"]["env_steps"])

    def begin_pretraining(self, dataset: Path, artifact: Path) -> None:
        """Get ready to pre-train on a dataset, or to go on where an interrupted pre-training stopped."""
        learner = self._learner = Learner(self._config, self._action_dim, self._device)
        learner.begin_pretraining(self._open(dataset))
        continue_unfinished(learner, artifact)

    def pretrain(self, num_steps: int) -> tuple[dict[str, float], int]:
        """Take gradient steps; gives metrics and the steps done in all."""
        learner = self.learner
        return (learner.pretrain(num_steps) if learner.pretrain_steps < self._config.pretrain.steps else {}), (
            learner.pretrain_steps
        )

    def save_pretraining(self, artifact: Path, *, finished: bool) -> None:
        """Write the pre-training's result, or what there is of it beside the place of the result."""
        (save_finished if finished else save_unfinished)(self.learner, artifact)

    def begin(self, dataset: Path, pretrained: Path | None, resume_from: Path | None) -> LearnerBeginning:
        """Build the agent and publish its first weights.

        Args:
            dataset: the random policy's data.
            pretrained: checkpoint of the pre-trained encoder, if there is one.
            resume_from: folder of the run's checkpoints; None for a fresh start.

        Raises:
            ValueError: a file does not fit or is damaged.
        """
        config = self._config
        store = CheckpointStore(resume_from, config.checkpoint.keep) if resume_from else None
        found = store.read_last(learning_hash(config), strict=config.checkpoint.strict) if store else None
        fetch = not (pretrained or found)
        learner = self._learner = Learner(config, self._action_dim, self._device, fetch_weights=fetch)
        data = self._open(dataset)
        if pretrained is not None:
            learner.load_pretrained(read_checkpoint(pretrained))
        learner.begin_rl(data)
        if found is not None:
            learner.load_checkpoint(found[0])
        self._introduce()
        if resume_from is not None:
            self._recover_from.use(resume_from)
        return LearnerBeginning(
            values=dict(found[0].values) if found is not None else {},
            problems=tuple(found[1]) if found is not None else (),
            schema=learner.schema(),
            random_steps=data.num_steps,
        )

    def _open(self, dataset: Path) -> FrameDataset:
        """The dataset, compared with its hashes once in this process."""
        data = open_dataset(dataset, dataset_hash(self._config), verify=dataset not in self._verified)
        self._verified.add(dataset)
        return data

    def _introduce(self) -> None:
        """Give policies the encoder and the first weights."""
        learner = self.learner
        arrays = {k: v.detach().cpu().numpy() for k, v in learner.encoder.state_dict().items()}
        self._hub.set_up_agents(AgentSetup(action_dim=self._action_dim, encoder=arrays))
        self._recovery = Recovery(learner)
        self._publisher = Publisher(learner, self._hub)
        # A learner that goes back to a checkpoint must not publish a version that its workers have already seen.
        self._publisher.start_over()

    def connect(self, store: SampleLink) -> None:
        """Take replay, which is built to this agent's schema."""
        self._store = store

    def refill(self, dataset: Path) -> int:
        """Store the random policy's data in replay; gives the steps."""
        return self._replay.insert_all(self.learner.stored_blocks(self._open(dataset)))

    def start(self) -> None:
        """Start fetching and updating."""
        links = self.learner, self._hub, self._replay, self._publishes, self._recover_from
        self._loops = LearningLoops(*links, self._between_updates)
        self._loops.start()

    def stop(self, timeout_s: float) -> int:
        """Stop after the running update and give back what was granted; gives the updates made.

        Raises:
            RoleSilentError: a thread still runs when time is up.
        """
        if self._loops is not None:
            self._loops.stop(timeout_s)
        return self._learner.updates if self._learner else 0

    def status(self) -> LearnerStatus:
        """How it does."""
        learner, loops = self._learner, self._loops
        if learner is None or loops is None:
            updates = learner.updates if learner else 0
            return LearnerStatus(updates=updates, metrics={"learner_wait_s_total": 0.0}, waiting_for="")
        with self._between_updates:
            updates, metrics = learner.updates, learner.metrics()
        metrics["learner_wait_s_total"] = loops.waited_s
        metrics["learner_rollbacks_total"] = self._recover_from.num_rollbacks
        if loops.update_s:
            metrics |= {"learner_update_s": loops.update_s, "learner_batch_wait_s": loops.batch_wait_s}
        return LearnerStatus(updates=updates, metrics=metrics, waiting_for=loops.waiting_for, error=loops.error)

    def hold_candidate(self) -> WeightSnapshot:
        """Keep the learner as it is between two updates, and publish it: what is evaluated now may become `best`."""
        with self._between_updates:
            self._candidate = self.learner.checkpoint({})
            return self._publishes.publish()

    def save(self, folder: Path, values: Mapping[str, Any], *, best: bool) -> tuple[int, int]:
        """Write a checkpoint between two updates, or the candidate as `best`; gives its size in bytes and its updates.

        Raises:
            OSError: it could not be written.
        """
        if best:
            if self._candidate is None:
                raise OSError("the learner that was evaluated has been lost since")
            checkpoint = dataclasses.replace(self._candidate, values={**self._candidate.values, **values})
        else:
            with self._between_updates:
                checkpoint = self.learner.checkpoint(values)
        updates = int(checkpoint.values["updates"])
        if "limiter" in values:
            limiter = {**values["limiter"], "updates": updates}
            checkpoint = dataclasses.replace(checkpoint, values={**checkpoint.values, "limiter": limiter})
        store = CheckpointStore(folder, self._config.checkpoint.keep)
        if best:
            return store.write_best(checkpoint), updates
        size = store.write(checkpoint, updates)
        self._recover_from.use(folder)
        return size, updates

    @property
    def learner(self) -> Learner:
        """Exists once pre-training or training has begun."""
        assert self._learner is not None, "begin comes first"
        return self._learner

    @property
    def _replay(self) -> SampleLink:
        assert self._store is not None, "connect comes first"
        return self._store

    @property
    def _publishes(self) -> Publisher:
        assert self._publisher is not None, "begin comes first"
        return self._publisher

    @property
    def _recover_from(self) -> Recovery:
        assert self._recovery is not None, "begin comes first"
        return self._recovery
