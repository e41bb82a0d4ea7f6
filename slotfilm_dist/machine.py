"""What this process has: cores and memory, seen through a container's limits, and the processor's arithmetic."""

import contextlib
import math
import os
import shutil
from pathlib import Path

GIB = 1024**3
CONTROL_GROUPS = Path("/sys/fs/cgroup")
MEMORY = Path("/proc/meminfo")


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


def takes_bfloat16(precision: str) -> bool:
    """Whether a precision of `float32`, `bfloat16` or `auto` means bfloat16 on this processor."""
    return precision == "bfloat16" or (precision == "auto" and has_bfloat16())


def has_c_compiler() -> bool:
    """Whether there is one of the C compilers that Triton looks for."""
    return any(shutil.which(name) for name in ("cc", "gcc", "clang"))


def usable_memory_bytes(control_groups: Path = CONTROL_GROUPS) -> int:
    """Memory that this process may use: the machine's, cut by the container's limit (control groups 2 and 1)."""
    installed = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    limits = (
        _read_words(control_groups / "memory.max", 1)[0],
        _read_words(control_groups / "memory" / "memory.limit_in_bytes", 1)[0],
    )
    return int(min(installed, *limits))


def used_memory_share(control_groups: Path = CONTROL_GROUPS, memory: Path = MEMORY) -> float:
    """Share of the memory that is in use for good: the machine's or the container's, whichever is the greater."""
    total, available = (_read_named(memory, name) for name in ("MemTotal:", "MemAvailable:"))
    shares = [1 - available / total if total and available else 0.0]
    for limit, used, prefix in (
        ("memory.max", "memory.current", ""),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "total_"),
    ):
        limit_bytes = _read_words(control_groups / limit, 1)[0]
        used_bytes = _read_words(control_groups / used, 1)[0]
        if used_bytes < math.inf and 0 < limit_bytes < math.inf:
            statistics = (control_groups / used).parent / "memory.stat"
            cached = sum(_read_named(statistics, f"{prefix}{kind}_file") for kind in ("active", "inactive"))
            shares.append(max(0.0, used_bytes - cached) / limit_bytes)
    return max(shares)


def ends_all_at_once(control_groups: Path = CONTROL_GROUPS) -> bool:
    """Whether the system ends every process of this container when its memory runs out, as in Kubernetes."""
    return _read_words(control_groups / "memory.oom.group", 1)[0] == 1


def offer_memory(score: int, process: Path = Path("/proc/self")) -> None:
    """Let the system end this process before those with a lower score when memory runs out (Linux, 0 to 1000).

    A higher score than asked for stays: a process may not take itself out of reach.
    """
    with contextlib.suppress(OSError, ValueError):
        file = process / "oom_score_adj"
        if int(file.read_text()) < score:
            file.write_text(str(score))


def _read_named(path: Path, name: str) -> float:
    """The number on the line of a name; 0 where there is none."""
    with contextlib.suppress(OSError, UnicodeDecodeError):
        for line in path.read_text(encoding="ascii").splitlines():
            words = line.split()
            if words[:1] == [name] and words[1:] and words[1].isdigit():
                return float(words[1])
    return 0.0


def _read_words(path: Path, count: int) -> list[float]:
    """The first numbers of a control group's file; infinity where there is no file, no number or no limit (`max`)."""
    try:
        words = path.read_text(encoding="ascii").split()[:count]
    except (OSError, UnicodeDecodeError):
        words = []
    numbers = [float(word) if word.lstrip("-").isdigit() else math.inf for word in words]
    return numbers + [math.inf] * (count - len(numbers))
