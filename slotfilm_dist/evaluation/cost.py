"""Parameters, latency and memory of an agent (Table A3)."""

import resource
import sys
import time
from dataclasses import dataclass

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
    device: str
    """What it was measured on."""


def cost_of(config: RunConfig, device: torch.device | str = "cpu", action_dim: int = _ACTION_DIM) -> CostRow:
    """Count and time one agent, on the device and with the torch threads as they are set."""
    device = torch.device(device)
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
    encoder_params, actor_params = count_params(encoder), count_params(actor)
    return CostRow(
        variant=config.variant,
        encoder_params=encoder_params,
        actor_params=actor_params,
        total_params=encoder_params + actor_params,
        latency_ms_mean=mean,
        latency_ms_std=float(times_ms.std(ddof=1)),
        rate_hz=1000.0 / mean,
        peak_memory_mb=_peak_memory_bytes(device) / 1e6,
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


def _peak_memory_bytes(device: torch.device) -> int:
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def _device_name(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{device.type}, {torch.get_num_threads()} threads"
