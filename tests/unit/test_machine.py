"""Limits of a container, from files laid out as the kernel does."""

import os
from pathlib import Path

import pytest

from slotfilm_dist.machine import (
    ends_all_at_once,
    has_bfloat16,
    offer_memory,
    takes_bfloat16,
    usable_cores,
    usable_memory_bytes,
    used_memory_share,
)


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


def test_auto_takes_bfloat16_where_the_processor_has_it() -> None:
    assert takes_bfloat16("auto") is has_bfloat16()
    assert takes_bfloat16("bfloat16")
    assert not takes_bfloat16("float32")


def test_processor_that_says_nothing_has_no_bfloat16(tmp_path: Path) -> None:
    assert not has_bfloat16(tmp_path / "nothing")


CONTAINERS = {
    "newer": ("memory.max", "memory.current", "memory.stat", ""),
    "older": (
        "memory/memory.limit_in_bytes",
        "memory/memory.usage_in_bytes",
        "memory/memory.stat",
        "total_",
    ),
}


def write_container(folder: Path, kind: str, limit: str, used: str, stat: str) -> None:
    for name, text in zip(CONTAINERS[kind], (limit, used, f"anon 5\n{stat}\n"), strict=False):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text + "\n")


@pytest.mark.parametrize("kind", CONTAINERS)
def test_used_memory_of_a_container_is_without_files_that_can_be_read_again(tmp_path: Path, kind: str) -> None:
    prefix = CONTAINERS[kind][3]
    write_container(tmp_path, kind, "1000", "999", f"{prefix}inactive_file 5\n{prefix}active_file 4\nslab 3")
    (tmp_path / "meminfo").write_text("MemTotal: 1000 kB\nMemAvailable: 250 kB\n")
    assert used_memory_share(tmp_path, tmp_path / "meminfo") == 0.99


@pytest.mark.parametrize("kind", CONTAINERS)
@pytest.mark.parametrize("words", ["max 999", "0 999", "1000 ?", "9223372036854771712 999"])
def test_used_memory_without_a_container_s_limit_is_the_machine_s(tmp_path: Path, kind: str, words: str) -> None:
    write_container(tmp_path, kind, *words.split(), "")
    (tmp_path / "meminfo").write_text(
        "MemTotal:   1000 kB\nMemFree:  1 kB\nMemAvailable:    250 kB\nHugePages_Total: 0\n"
    )
    assert used_memory_share(tmp_path, tmp_path / "meminfo") == 0.75


def test_used_memory_of_an_old_kernel_is_not_known(tmp_path: Path) -> None:
    (tmp_path / "meminfo").write_text("MemTotal:   1000 kB\nMemFree:  1 kB\n")
    assert used_memory_share(tmp_path, tmp_path / "meminfo") == 0.0


@pytest.mark.parametrize(("text", "all_at_once"), [("1\n", True), ("0\n", False), (None, False)])
def test_container_that_is_ended_as_a_whole_is_known(tmp_path: Path, text: str | None, all_at_once: bool) -> None:
    if text is not None:
        (tmp_path / "memory.oom.group").write_text(text)
    assert ends_all_at_once(tmp_path) is all_at_once


def test_used_memory_of_this_machine_is_a_share() -> None:
    assert 0 < used_memory_share() < 1


def test_process_offers_its_memory_but_never_takes_an_offer_back(tmp_path: Path) -> None:
    file = tmp_path / "oom_score_adj"
    file.write_text("0\n")
    offer_memory(400, tmp_path)
    assert file.read_text() == "400"
    offer_memory(200, tmp_path)
    assert file.read_text() == "400"
    offer_memory(200, tmp_path / "not there")
