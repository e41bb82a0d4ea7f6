"""What this process has: cores and memory, seen through a container's limits, and the processor's arithmetic."""

import math
import os
from pathlib import Path

GIB = 1024**3
CONTROL_GROUPS = Path("/sys/fs/cgroup")


def usable_cores(control_groups: Path = CONTROL_GROUPS) -> float:
    """Cores that this process may use: those it is bound to, cut by the container's quota (control groups 2 and 1)."""
    quota, period = _read_words(control_groups / "cpu.max", 2)
    if math.isinf(quota):
        quota, period = (
            _read_words(control_groups / "cpu" / name, 1)[0] for name in ("cpu.cfs_quota_us", "cpu.cfs_period_us")
        )
    cores = float(len(os.sched_getaffinity(0)))
    # A quota of -1 is none.
    return min(cores, quota / period) if 0 < quota < math.inf and 0 < period < math.inf else cores


def has_bfloat16(processors: Path = Path("/proc/cpuinfo")) -> bool:
    """Whether the processor multiplies bfloat16 numbers itself (AVX-512 BF16 or AMX)."""
    try:
        text = processors.read_text(encoding="utf-8")
    except OSError:
        return False
    flags = next((line for line in text.splitlines() if line.startswith("flags")), "").split()
    return not {"avx512_bf16", "amx_bf16"}.isdisjoint(flags)


def usable_memory_bytes(control_groups: Path = CONTROL_GROUPS) -> int:
    """Memory that this process may use: the machine's, cut by the container's limit (control groups 2 and 1)."""
    installed = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    limits = (
        _read_words(control_groups / "memory.max", 1)[0],
        _read_words(control_groups / "memory" / "memory.limit_in_bytes", 1)[0],
    )
    return int(min(installed, *limits))


def _read_words(path: Path, count: int) -> list[float]:
    """The first numbers of a control group's file; infinity where there is no file, no number or no limit (`max`)."""
    try:
        words = path.read_text(encoding="ascii").split()[:count]
    except (OSError, UnicodeDecodeError):
        words = []
    numbers = [float(word) if word.lstrip("-").isdigit() else math.inf for word in words]
    return numbers + [math.inf] * (count - len(numbers))
