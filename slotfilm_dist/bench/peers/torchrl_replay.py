"""TorchRL's replay buffer in a Ray actor, with the rows of ours, in a process of its own with a Ray of its own."""

# pyright: reportMissingImports=false
# Some of these packages are in the peers' environment only.

import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import ray
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, RayReplayBuffer

from slotfilm_dist.bench.agent import bench_config
from slotfilm_dist.bench.serving import serve
from slotfilm_dist.bench.transitions import token_batch


def build(*, num_rows: int, batch_size: int) -> Mapping[str, Callable[..., float]]:
    """`measure`: rows sampled a second by so many clients at once."""
    torch.set_num_threads(1)
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, object_store_memory=1 << 30)
    buffer = RayReplayBuffer(
        storage=partial(LazyTensorStorage, num_rows), batch_size=batch_size, remote_config={"num_cpus": 0}
    )
    config, rng = bench_config(), np.random.default_rng(0)
    part = 500
    for _ in range(num_rows // part):
        buffer.extend(_rows(rng, part, config))
    clients = buffer.clients(4)

    def work(client: object, num_batches: int) -> None:
        for _ in range(num_batches):
            client.sample()  # type: ignore[attr-defined]  # TorchRL gives no type

    def measure(num_clients: int, num_batches: int) -> float:
        began = time.perf_counter()
        with ThreadPoolExecutor(num_clients) as pool:
            list(pool.map(work, clients[:num_clients], [num_batches] * num_clients))
        return num_clients * num_batches * batch_size / (time.perf_counter() - began)

    return {"measure": measure}


def _rows(rng: np.random.Generator, size: int, config: object) -> TensorDict:
    batch = token_batch(rng, size, config)  # type: ignore[arg-type]
    names = ("visual", "proprio", "goal", "action", "reward", "terminated", "truncated")
    following = {name: torch.from_numpy(getattr(batch, f"next_{name}")) for name in ("visual", "proprio", "goal")}
    now = {name: torch.from_numpy(getattr(batch, name)) for name in names}
    return TensorDict(now | {"next": TensorDict(following, [size])}, [size])


if __name__ == "__main__":
    serve(build)
