"""Evaluation episodes in processes of their own."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from slotfilm_dist.backend import Player, RunFailedError
from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError
from slotfilm_dist.cluster.messages import AgentSetup
from slotfilm_dist.cluster.role_clients import PlayerClient
from slotfilm_dist.config import RunConfig
from slotfilm_dist.messages import EpisodeSummary, WeightSnapshot

PREPARE_S = 180.0
"""Longest time to build an environment and a policy."""
EPISODE_S = 600.0
"""Longest time of one episode, drawing its video included."""
SLICE_S = 0.05
MAX_LOSSES = 3
"""Players lost in one evaluation before it is given up."""


class EvaluationPool:
    """Players that share the episodes of an evaluation; a lost one is replaced and its episode played again.

    Args:
        config: the run.
        make_env: builds an environment.
        share_cpus: cores of each player.
        size: number of players.
    """

    def __init__(self, config: RunConfig, make_env: Callable[..., Any], share_cpus: float, size: int) -> None:
        self._config, self._make_env, self._share_cpus = config, make_env, share_cpus
        self._num_launched = self._num_lost = 0
        self._players = [self._launch() for _ in range(size)]

    @property
    def size(self) -> int:
        """Number of players."""
        return len(self._players)

    def play(
        self,
        player: Player,
        seeds: Sequence[int],
        *,
        camera: bool,
        setup: AgentSetup | None,
        snapshot: WeightSnapshot | None,
    ) -> Iterator[EpisodeSummary]:
        """One episode for each seed, given in the order of the seeds.

        Raises:
            RunFailedError: players were lost again and again.
        """
        self._num_lost = 0
        ready = [(p, p.begin_prepare(player, camera, setup, snapshot), -1) for p in self._players]
        waiting, finished = list(range(len(seeds))), dict[int, EpisodeSummary]()
        next_given = 0
        while next_given < len(seeds):
            client, request, index = ready.pop(0)
            try:
                answer = client.answer(request, "an episode", SLICE_S)
                if index >= 0:
                    finished[index] = answer
                if waiting:
                    index = waiting.pop(0)
                    ready.append((client, client.begin_play(seeds[index]), index))
            except RoleSilentError:
                ready.append((client, request, index))
            except RoleLostError as error:
                if index >= 0:
                    waiting.insert(0, index)
                client = self._replace(client, error)
                ready.append((client, client.begin_prepare(player, camera, setup, snapshot), -1))
            while next_given in finished:
                yield finished.pop(next_given)
                next_given += 1

    def record(
        self,
        player: Player,
        seed: int,
        video: Path,
        film_strip: Path,
        *,
        setup: AgentSetup | None,
        snapshot: WeightSnapshot | None,
    ) -> EpisodeSummary:
        """One episode with the camera on, written as a video and a film strip."""
        while True:
            client = self._players[0]
            try:
                client.answer(client.begin_prepare(player, True, setup, snapshot), "its environment", PREPARE_S)
                return client.answer(client.begin_record(seed, video, film_strip), "a video", EPISODE_S)
            except (RoleLostError, RoleSilentError) as error:
                self._replace(client, error)

    def close(self) -> None:
        """End all players."""
        for player in self._players:
            player.kill()
        self._players = []

    def _launch(self) -> PlayerClient:
        self._num_launched += 1
        return PlayerClient.launch(self._config, self._num_launched, self._make_env, self._share_cpus)

    def _replace(self, client: PlayerClient, error: Exception) -> PlayerClient:
        client.kill()
        self._num_lost += 1
        if self._num_lost >= MAX_LOSSES:
            raise RunFailedError(f"evaluation gave up after {self._num_lost} lost processes, last: {error}")
        fresh = self._launch()
        self._players[self._players.index(client)] = fresh
        return fresh
