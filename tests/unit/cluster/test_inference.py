"""Central inference against a worker's own: the same tokens and actions, in batches, with faults."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from slotfilm_dist.cluster import inference
from slotfilm_dist.cluster.acting import WeightLink
from slotfilm_dist.cluster.central_policy import CentralPolicy
from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError
from slotfilm_dist.cluster.inference import InferenceServer
from slotfilm_dist.cluster.messages import AgentSetup, InferenceAnswer, InferenceRequest, InferenceStatus
from slotfilm_dist.cluster.worker import build_policy
from slotfilm_dist.config import RunConfig
from slotfilm_dist.envs.toy import ACTION_DIM, ToyEnv
from slotfilm_dist.messages import TransitionBlock, WeightSnapshot
from slotfilm_dist.nets.agent import build_actor, build_encoder
from slotfilm_dist.policy import AgentPolicy
from slotfilm_dist.presets import smoke
from slotfilm_dist.rollout import RolloutLoop
from slotfilm_dist.variants import apply_variant

SEED = np.random.SeedSequence(3)


class Weights(WeightLink):
    """A hub with one snapshot."""

    def __init__(self, snapshot: WeightSnapshot | None) -> None:
        self.snapshot = snapshot

    def await_newer(self, newer_than: int, timeout_s: float) -> WeightSnapshot | None:
        if self.snapshot is not None and self.snapshot.version > newer_than:
            return self.snapshot
        time.sleep(min(timeout_s, 0.02))
        return None


class Direct:
    """Asks a server in this process; fails as often as it is told to before."""

    def __init__(self, server: InferenceServer, *failures: Exception) -> None:
        self._server, self.failures = server, list(failures)

    def infer(self, request: InferenceRequest) -> InferenceAnswer:
        if self.failures:
            raise self.failures.pop(0)
        return self._server.infer(request)

    def has_weights(self, timeout_s: float) -> bool:
        return self._server.status().policy_version >= 0


def config_of(variant: str) -> RunConfig:
    base = apply_variant(variant, smoke())
    return replace(base, env=replace(base.env, image_size=32, max_steps=6))


def agent_of(config: RunConfig) -> tuple[AgentSetup, WeightSnapshot]:
    encoder = build_encoder(config)
    encoder.freeze_backbone()
    encoder.eval()
    actor = build_actor(config, encoder, ACTION_DIM)
    arrays = {f"encoder.{k}": v for k, v in encoder.acting_state().items()}
    arrays |= {f"actor.{k}": v.detach().numpy() for k, v in actor.state_dict().items()}
    setup = AgentSetup(action_dim=ACTION_DIM, encoder={k: v.detach().numpy() for k, v in encoder.state_dict().items()})
    return setup, WeightSnapshot(version=4, published_at_s=time.time(), arrays=arrays)


def collect(config: RunConfig, policy: AgentPolicy | CentralPolicy, worker_id: int = 0) -> TransitionBlock:
    env = ToyEnv(config, camera=config.encoder.uses_image)
    loop = RolloutLoop(env, policy, np.random.SeedSequence(worker_id), worker_id)
    blocks = [loop.collect(9) for _ in range(2)]
    return blocks[-1]


def central(server: InferenceServer, worker_id: int = 0, *failures: Exception, **options: object) -> CentralPolicy:
    options = {"note": lambda activity: None} | options
    return CentralPolicy(Direct(server, *failures), worker_id, ACTION_DIM, SEED, **options)


def own(config: RunConfig, setup: AgentSetup, snapshot: WeightSnapshot) -> AgentPolicy:
    policy = build_policy(config, setup, SEED)
    policy.load(snapshot.version, snapshot.arrays)
    return policy


@pytest.mark.parametrize("variant", ["slotfilm", "state_only", "cnn"])
def test_transitions_equal_those_of_a_workers_own_inference(variant: str) -> None:
    config = config_of(variant)
    setup, snapshot = agent_of(config)
    server = InferenceServer(build_policy(config, setup, SEED), Weights(snapshot))
    there, here = collect(config, central(server)), collect(config, own(config, setup, snapshot))
    server.close()
    for name in ("visual", "action", "reward", "proprio", "is_step"):
        np.testing.assert_array_equal(getattr(there, name), getattr(here, name), err_msg=name)
    assert (there.policy_version, there.backbone_hash) == (4, here.backbone_hash)


def test_workers_are_computed_together_and_get_their_own_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inference, "ACTIVE_S", 60.0)
    config = config_of("slotfilm")
    setup, snapshot = agent_of(config)
    server = InferenceServer(build_policy(config, setup, SEED), Weights(snapshot), deadline_s=0.5)
    blocks: dict[int, TransitionBlock] = {}
    before: list[InferenceStatus] = []
    all_active = threading.Barrier(3, action=lambda: before.append(server.status()))

    def work(worker_id: int) -> None:
        central(server, worker_id).visual(ToyEnv(config, camera=True).reset([0]))
        all_active.wait(60)
        blocks[worker_id] = collect(config, central(server, worker_id), worker_id)

    threads = [threading.Thread(target=work, args=(worker_id,)) for worker_id in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    status = server.status()
    server.close()
    num_steps, num_batches = (getattr(status, n) - getattr(before[0], n) for n in ("num_steps", "num_batches"))
    assert num_steps / num_batches > 2
    assert len(blocks) == 3
    for worker_id, block in blocks.items():
        alone = collect(config, own(config, setup, snapshot), worker_id)
        # A larger product may round differently in the last digit.
        np.testing.assert_allclose(block.visual.astype(np.float32), alone.visual.astype(np.float32), atol=2e-3)
        np.testing.assert_allclose(block.action, alone.action, atol=2e-3)


def test_partial_batch_is_computed_when_its_deadline_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inference, "ACTIVE_S", 60.0)
    config = config_of("state_only")
    setup, snapshot = agent_of(config)
    server = InferenceServer(build_policy(config, setup, SEED), Weights(snapshot), deadline_s=0.05)
    other, policy = central(server, 1), central(server, 0)
    seen = ToyEnv(config, camera=False).reset([0])
    other.visual(seen)  # active from now on, and silent
    began = time.monotonic()
    policy.visual(seen)
    took_s = time.monotonic() - began
    server.close()
    assert 0.04 <= took_s < 10.0
    assert server.status().num_batches == 2


def test_weights_are_waited_for_by_name() -> None:
    config = config_of("state_only")
    setup, snapshot = agent_of(config)
    weights = Weights(None)
    server = InferenceServer(build_policy(config, setup, SEED), weights)
    policy = central(server)
    assert not policy.await_weights(0.01)
    weights.snapshot = snapshot
    deadline = time.monotonic() + 10
    while not policy.await_weights(0.01):
        assert time.monotonic() < deadline
    server.close()


def test_request_is_repeated_with_the_same_noise_while_the_process_is_started_again() -> None:
    config = config_of("slotfilm")
    setup, snapshot = agent_of(config)
    server = InferenceServer(build_policy(config, setup, SEED), Weights(snapshot))
    waits: list[str] = []
    gone = [RoleLostError("inference", "crash", "killed"), RoleSilentError("inference", "actions", 1.0)]
    there = collect(config, central(server, 0, *gone, note=waits.append))
    here = collect(config, own(config, setup, snapshot))
    server.close()
    np.testing.assert_array_equal(there.action, here.action)
    assert set(waits) == {"actions of the inference process"}


def test_process_that_stays_away_is_named_when_patience_is_over() -> None:
    config = config_of("state_only")
    setup, snapshot = agent_of(config)
    server = InferenceServer(build_policy(config, setup, SEED), Weights(snapshot))
    gone = [RoleLostError("inference", "crash", "killed")] * 9
    policy = central(server, 0, *gone, patience_s=0.3)
    with pytest.raises(RoleSilentError, match=r"inference did not answer within 0\.3 s: actions; last: .* killed"):
        policy.visual(ToyEnv(config, camera=False).reset([0]))
    server.close()


def test_process_that_never_starts_is_named_when_patience_is_over() -> None:
    class Nobody:
        def infer(self, request: InferenceRequest) -> InferenceAnswer:
            raise RoleSilentError("inference", "actions", 0.0)

        def has_weights(self, timeout_s: float) -> bool:
            raise RoleSilentError("inference", "its weights' version", timeout_s)

    policy = CentralPolicy(Nobody(), 0, ACTION_DIM, SEED, lambda activity: None, patience_s=0.2)

    def wait() -> None:
        deadline = time.monotonic() + 10
        while not policy.await_weights(0.01):
            assert time.monotonic() < deadline

    with pytest.raises(RoleSilentError, match=r"inference did not answer within 0\.2 s: its start"):
        wait()


def test_mistake_in_a_request_is_told_to_who_asked_and_the_server_goes_on() -> None:
    config = config_of("state_only")
    setup, snapshot = agent_of(config)
    server = InferenceServer(build_policy(config, setup, SEED), Weights(snapshot))
    good = ToyEnv(config, camera=False).reset([0])
    wrong = replace(good, proprio=np.zeros((1, 3), np.float32))
    with pytest.raises(Exception, match="size of tensor"):
        central(server).visual(wrong)
    assert central(server).visual(good).shape == (1, 0)
    server.close()
