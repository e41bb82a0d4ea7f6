"""Limits of a container, from files laid out as the kernel does."""

import os
from pathlib import Path

import pytest

from slotfilm_dist.machine import has_bfloat16, usable_cores, usable_memory_bytes


@pytest.mark.parametrize("name", ["memory.max", "memory/memory.limit_in_bytes"])
def test_memory_limit_of_a_container_counts(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.parent.mkdir(exist_ok=True)
    file.write_text("67108864\n")
    assert usable_memory_bytes(tmp_path) == 67108864


@pytest.mark.parametrize("text", [None, "max\n", "9223372036854771712\n", "", "?"])
def test_without_a_memory_limit_the_machine_s_memory_counts(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "memory.max").write_text(text)
    assert usable_memory_bytes(tmp_path) == os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def test_cpu_quota_of_a_container_counts(tmp_path: Path) -> None:
    (tmp_path / "cpu.max").write_text("50000 100000\n")
    assert usable_cores(tmp_path) == 0.5


def test_cpu_quota_of_the_older_control_groups_counts(tmp_path: Path) -> None:
    (tmp_path / "cpu").mkdir()
    (tmp_path / "cpu" / "cpu.cfs_period_us").write_text("100000\n")
    (tmp_path / "cpu" / "cpu.cfs_quota_us").write_text("25000\n")
    assert usable_cores(tmp_path) == 0.25
    (tmp_path / "cpu" / "cpu.cfs_quota_us").write_text("-1\n")
    assert usable_cores(tmp_path) == len(os.sched_getaffinity(0))


@pytest.mark.parametrize("text", [None, "max 100000\n", "", "a b"])
def test_without_a_cpu_quota_the_cores_count(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "cpu.max").write_text(text)
    assert usable_cores(tmp_path) == len(os.sched_getaffinity(0))


@pytest.mark.parametrize(
    ("text", "has"),
    [
        ("processor : 0\nflags\t\t: fpu avx512f avx512_bf16\n", True),
        ("flags : fpu amx_bf16 amx_tile\n", True),
        ("flags : fpu avx2 avx512f\n", False),
        ("Features : asimd bf16\n", False),
    ],
)
def test_bfloat16_is_known_by_the_processor_s_flags(tmp_path: Path, text: str, has: bool) -> None:
    (tmp_path / "cpuinfo").write_text(text)
    assert has_bfloat16(tmp_path / "cpuinfo") is has


def test_processor_that_says_nothing_has_no_bfloat16(tmp_path: Path) -> None:
    assert not has_bfloat16(tmp_path / "nothing")
