"""Parameters, latency and memory of an agent (Table A3)."""

import multiprocessing
import resource
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn

from slotfilm_dist.config import RunConfig
from slotfilm_dist.nets.agent import AgentActor, AgentEncoder, build_actor, build_encoder

_ACTION_DIM = 7
_WARM_UP_PASSES = 10
_TIMED_PASSES = 100


@dataclass(frozen=True, kw_only=True, slots=True)
class CostRow:
    """One agent's row of the cost table. Weights do not change the cost, so freshly drawn ones are measured."""

    variant: str
    encoder_params: int
    """Encoder with its heads."""
    actor_params: int
    total_params: int
    """Encoder and actor."""
    latency_ms_mean: float
    """Mean time from a picture in memory to an action in memory, one at a time, in milliseconds."""
    latency_ms_std: float
    """Standard deviation of that time between passes, in milliseconds."""
    rate_hz: float
    """Actions a second at the mean latency."""
    peak_memory_mb: float
    """Most memory used, in MB: torch's allocations on a GPU, the whole process (libraries too) on a CPU."""
    model_memory_mb: float
    """That without what was in use before the agent was built: the agent's weights and what a pass needs, in MB."""
    device: str
    """What it was measured on."""


def costs_of(configs: Sequence[RunConfig], device: torch.device | str) -> Iterator[CostRow]:
    """The rows of several agents, each measured in a fresh process, so that none finds another's memory there."""
    for config in configs:
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
            yield process.submit(cost_of, config, str(device)).result()


def cost_of(config: RunConfig, device: torch.device | str = "cpu", action_dim: int = _ACTION_DIM) -> CostRow:
    """Count and time one agent, on the device and with the torch threads as they are set.

    Latency is averaged over 100 passes of batch size one that follow 10 others (Appendix A.3). The memory of a process
    that has measured before holds the largest agent so far: use `costs_of` for more than one.
    """
    device = torch.device(device)
    before = _memory_bytes(device)
    generator = torch.Generator().manual_seed(config.seed)
    encoder = build_encoder(config, fetch_weights=False)
    if not config.sac.end_to_end:
        encoder.freeze_backbone()
    actor = build_actor(config, encoder, action_dim, generator)
    encoder.to(device).eval()
    actor.to(device)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    times_ms = _time_passes(encoder, actor, config, device)
    mean = float(times_ms.mean())
    peak = _peak_memory_bytes(device)
    encoder_params, actor_params = count_params(encoder), count_params(actor)
    return CostRow(
        variant=config.variant,
        encoder_params=encoder_params,
        actor_params=actor_params,
        total_params=encoder_params + actor_params,
        latency_ms_mean=mean,
        latency_ms_std=float(times_ms.std(ddof=1)),
        rate_hz=1000.0 / mean,
        peak_memory_mb=peak / 1e6,
        model_memory_mb=(peak - before) / 1e6,
        device=_device_name(device),
    )


def count_params(module: nn.Module) -> int:
    """Number of parameters, trained or frozen; buffers do not count."""
    return sum(parameter.numel() for parameter in module.parameters())


@torch.inference_mode()
def _time_passes(encoder: AgentEncoder, actor: AgentActor, config: RunConfig, device: torch.device) -> np.ndarray:
    """Milliseconds of each timed pass, after a warm-up."""
    rng = np.random.default_rng(config.seed)
    size = config.env.image_size
    rgb = torch.from_numpy(rng.integers(0, 256, (1, size, size, 3), dtype=np.uint8))
    proprio = torch.from_numpy(rng.standard_normal((1, config.obs.state_dim), dtype=np.float32))
    goal = torch.tensor([[0.5, 0.5, 1.0]])
    times_ms: list[float] = []
    for _ in range(_WARM_UP_PASSES + _TIMED_PASSES):
        start_s = time.perf_counter()
        visual = encoder.to_visual(rgb.to(device))
        actor.mode(encoder(visual, proprio.to(device), goal.to(device))).cpu()
        times_ms.append(1000.0 * (time.perf_counter() - start_s))
    return np.array(times_ms[_WARM_UP_PASSES:])


def _memory_bytes(device: torch.device) -> int:
    """Memory in use now; 0 where the system does not tell."""
    if device.type == "cuda":
        return torch.cuda.memory_allocated(device)
    return _process_memory_bytes("VmRSS") or 0


def _peak_memory_bytes(device: torch.device) -> int:
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    peak = _process_memory_bytes("VmHWM")
    if peak is not None:
        return peak
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def _process_memory_bytes(field: str) -> int | None:
    """A field of Linux's account of this process; None on other systems.

    `ru_maxrss` would not do: a child process begins with its parent's.
    """
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(field + ":")), None)


def _device_name(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{device.type}, {torch.get_num_threads()} threads"
