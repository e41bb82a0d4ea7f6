"""cpprb's buffer in process, with the rows of ours, in a process of its own."""

# pyright: reportMissingImports=false
# Some of these packages are in the peers' environment only.

import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from cpprb import ReplayBuffer

from slotfilm_dist.bench.agent import bench_config
from slotfilm_dist.bench.serving import serve
from slotfilm_dist.bench.transitions import ACTION_DIM, TOKEN_SHAPE, token_batch


def build(*, num_rows: int, batch_size: int) -> Mapping[str, Callable[..., float]]:
    """`measure`: rows sampled a second by so many threads at once; frames are stored once (`next_of`)."""
    config, rng = bench_config(), np.random.default_rng(0)
    shapes = {
        "visual": {"shape": TOKEN_SHAPE, "dtype": np.float16},
        "proprio": {"shape": (config.obs.state_dim,), "dtype": np.float32},
        "goal": {"shape": (3,), "dtype": np.float32},
        "action": {"shape": (ACTION_DIM,), "dtype": np.float32},
        "reward": {"dtype": np.float32},
        "terminated": {"dtype": np.bool_},
        "truncated": {"dtype": np.bool_},
    }
    frames = ("visual", "proprio", "goal")
    buffer = ReplayBuffer(num_rows, shapes, next_of=frames)
    for _ in range(num_rows // 500):
        batch = token_batch(rng, 500, config)
        nexts = {f"next_{name}": getattr(batch, f"next_{name}") for name in frames}
        buffer.add(**{name: getattr(batch, name) for name in shapes}, **nexts)

    def work(num_batches: int) -> None:
        for _ in range(num_batches):
            buffer.sample(batch_size)

    def measure(num_clients: int, num_batches: int) -> float:
        began = time.perf_counter()
        with ThreadPoolExecutor(num_clients) as pool:
            list(pool.map(work, [num_batches] * num_clients))
        return num_clients * num_batches * batch_size / (time.perf_counter() - began)

    return {"measure": measure}


if __name__ == "__main__":
    serve(build)
