"""Evaluation episodes in processes of their own."""

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from slotfilm_dist.backend import EvaluationFailedError, Player
from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError
from slotfilm_dist.cluster.messages import AgentSetup
from slotfilm_dist.cluster.role_clients import PlayerClient
from slotfilm_dist.config import RunConfig
from slotfilm_dist.messages import EpisodeSummary, WeightSnapshot
from slotfilm_dist.rejection import BrokenEnvironmentError

PREPARE_S = 180.0
"""Longest time to build an environment and a policy."""
EPISODE_S = 600.0
"""Longest time of one episode, drawing its video included."""
SLICE_S = 0.05
MAX_LOSSES = 3
"""Players lost in one evaluation before it is given up."""


class _Request:
    """What a player has been asked for."""

    def __init__(self, client: PlayerClient, request: Any, limit_s: float, index: int = -1) -> None:
        self.client, self.request, self.index = client, request, index
        self.limit_s, self.until = limit_s, time.monotonic() + limit_s
        """How long it may take, and until when; then the player is replaced."""
        self.what = "its environment" if index < 0 else "an episode"


class EvaluationPool:
    """Players that share the episodes of an evaluation; a lost one is replaced and its episode played again.

    Args:
        config: the run.
        make_env: builds an environment.
        share_cpus: cores of each player.
        size: players from the start.
    """

    def __init__(self, config: RunConfig, make_env: Callable[..., Any], share_cpus: float, size: int = 0) -> None:
        self._config, self._make_env, self._share_cpus = config, make_env, share_cpus
        self._num_launched = self._num_lost = 0
        self._under_way: list[_Request] = []
        self._players: list[PlayerClient] = []
        self.grow(size)

    def grow(self, size: int) -> None:
        """Start players until there are at least so many."""
        self._players += [self._launch() for _ in range(size - len(self._players))]

    def room(self, free_cpus: float) -> int:
        """Players that find cores: those that are there, and more on the free ones."""
        return len(self._players) + int(free_cpus / self._share_cpus + 1e-6)

    @property
    def size(self) -> int:
        """Number of players."""
        return len(self._players)

    def play(
        self,
        player: Player,
        seeds: Sequence[int],
        give_up: Callable[[], bool],
        *,
        camera: bool,
        setup: AgentSetup | None,
        snapshot: WeightSnapshot | None,
    ) -> Iterator[EpisodeSummary]:
        """One episode for each seed, given in the order of the seeds.

        Args:
            player: who plays.
            seeds: of the episodes.
            give_up: asked many times a second; the episodes end once it says so, or with what it raises.
            camera: whether the player sees.
            setup: of the agent.
            snapshot: its weights.

        Raises:
            EvaluationFailedError: players were lost, broken, or silent for too long, again and again.
        """
        self._num_lost = 0

        def prepare(client: PlayerClient) -> _Request:
            return _Request(client, client.begin_prepare(player, camera, setup, snapshot), PREPARE_S)

        self._under_way = [prepare(client) for client in self._players]
        waiting, finished = list(range(len(seeds))), dict[int, EpisodeSummary]()
        next_given = 0
        try:
            while next_given < len(seeds) and not give_up():
                asked = self._under_way.pop(0)
                try:
                    answer = asked.client.answer(asked.request, asked.what, SLICE_S)
                    if asked.index >= 0:
                        finished[asked.index] = answer
                    if waiting:
                        index = waiting.pop(0)
                        request = asked.client.begin_play(seeds[index])
                        self._under_way.append(_Request(asked.client, request, EPISODE_S, index))
                except (RoleLostError, RoleSilentError, BrokenEnvironmentError) as error:
                    if isinstance(error, RoleSilentError):
                        if time.monotonic() < asked.until:
                            self._under_way.append(asked)
                            continue
                        error = RoleSilentError(error.name, asked.what, asked.limit_s)
                        if self._left_out(asked):
                            continue
                    if asked.index >= 0:
                        waiting.insert(0, asked.index)
                    self._under_way.append(prepare(self._replace(asked.client, error)))
                while next_given in finished:
                    yield finished.pop(next_given)
                    next_given += 1
        finally:
            if self._under_way:
                self.close()  # whoever is at something that nobody waits for

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
            except (RoleLostError, RoleSilentError, BrokenEnvironmentError) as error:
                self._replace(client, error)

    def close(self) -> None:
        """End all players."""
        for player in self._players:
            player.kill()
        self._players = []

    def _launch(self) -> PlayerClient:
        self._num_launched += 1
        return PlayerClient.launch(self._config, self._num_launched, self._make_env, self._share_cpus)

    def _left_out(self, asked: _Request) -> bool:
        """A player that has not begun while another plays finds no core; it goes, and counts for nothing."""
        if asked.index >= 0 or not any(other.index >= 0 for other in self._under_way):
            return False
        asked.client.kill()
        self._players.remove(asked.client)
        return True

    def _replace(self, client: PlayerClient, error: Exception) -> PlayerClient:
        client.kill()
        self._num_lost += 1
        if self._num_lost >= MAX_LOSSES:
            raise EvaluationFailedError(
                f"evaluation gave up after {self._num_lost} lost processes, last: {error}; is a core free for it? "
                "Go on with --resume"
            )
        fresh = self._launch()
        self._players[self._players.index(client)] = fresh
        return fresh
