"""One shard full of token steps in a process of its own, so that its memory can be told."""

import resource
from collections.abc import Callable, Mapping

from slotfilm_dist.bench.agent import bench_config
from slotfilm_dist.bench.filled_shards import rows_per_s, shards_in_process
from slotfilm_dist.bench.serving import serve


def build(*, num_steps: int) -> Mapping[str, Callable[..., float]]:
    """`measure`: rows a second that one client samples; `peak_memory_gb`: growth of the largest resident size."""
    before = _peak_gb()
    config = bench_config()
    store = shards_in_process(config, num_steps)
    return {
        "measure": lambda num_requests: rows_per_s([store], num_requests, 8, config.sac.batch_size),
        "peak_memory_gb": lambda: _peak_gb() - before,
    }


def _peak_gb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


if __name__ == "__main__":
    serve(build)
