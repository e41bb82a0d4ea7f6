"""What this machine can do, and a fix for each thing that it lacks (`slotfilm doctor`).

The checks only look: they install nothing and change nothing. Those that import something heavy do it in a child
process, so that a broken installation is a line of the report and not the end of it.
"""

import importlib.metadata
import json as json_format
import os
import platform
import resource
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from slotfilm_dist.config import RuntimeConfig
from slotfilm_dist.dashboards import dashboard_urls, probe_dashboard
from slotfilm_dist.envs.vulkan_probe import VulkanProbe, probe_vulkan, software_driver
from slotfilm_dist.machine import GIB, usable_cores, usable_memory_bytes, used_memory_share

DISTRIBUTION = "slotfilm-dist"
QUICK_MEMORY_GB = 6.0
RUN_DISK_GB = 2.0
AMPLE_DISK_GB = 20.0
SHARED_MEMORY_GB = 1.0
OPEN_FILES = 4096
IMPORT_TIMEOUT_S = 120.0
NAME_WIDTH = 16

Status = Literal["ok", "warn", "fail"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Check:
    """One line of the report."""

    name: str
    """What was looked at."""
    status: Status
    """`ok`; `warn`: the quick preset runs, something else is missing; `fail`: it cannot run, or must not yet."""
    found: str
    """What is there."""
    fix: str = ""
    """What to do about it; empty where the status is ok."""


def run_doctor(json: bool) -> int:
    """Check this machine and print the report.

    Args:
        json: Print one JSON object instead of a table.

    Returns:
        Exit status: 0 if the main job (`slotfilm train quick`) can run, else 1.
    """
    checks = collect_checks()
    ready = is_ready(checks)
    if json:
        print(json_format.dumps({"ready": ready, "checks": [asdict(check) for check in checks]}, indent=2))
    else:
        print_table(checks)
    return 0 if ready else 1


def is_ready(checks: Sequence[Check]) -> bool:
    """Whether the main job can run: no check failed."""
    return all(check.status != "fail" for check in checks)


def collect_checks() -> list[Check]:
    """All checks, in the report's order; the slow ones run beside each other."""
    with ThreadPoolExecutor() as pool:
        probe = pool.submit(probe_best_driver)
        gpu = pool.submit(check_gpu)
        ray = pool.submit(check_ray)
        dashboards = pool.submit(lambda: check_dashboards(dashboard_urls(os.environ.get("RAY_ADDRESS", ""))))
        return [
            check_python(sys.version_info[:3]),
            check_packages(),
            check_vulkan(*probe.result()),
            gpu.result(),
            ray.result(),
            dashboards.result(),
            check_cores(usable_cores()),
            check_memory(usable_memory_bytes() / GIB, used_memory_share()),
            check_disk(Path.cwd()),
            check_shared_memory(Path("/dev/shm")),
            check_open_files(*resource.getrlimit(resource.RLIMIT_NOFILE)),
            check_ycb(ycb_folder()),
            check_imagenet(hub_folder() / "checkpoints"),
            check_physx_gpu(
                Path.home() / ".sapien" / "physx", probe.result()[0].physx_version, gpu.result().status == "ok"
            ),
        ]


def print_table(checks: Sequence[Check]) -> None:
    """Print the report for a person: a table, then the fixes, then the verdict."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False)
    colours = {"ok": "green", "warn": "yellow", "fail": "bold red"}
    for check in checks:
        line = Table.grid(padding=(0, 2, 0, 0))
        line.add_column(width=4)
        line.add_column(width=NAME_WIDTH)
        line.add_row(Text(check.status, style=colours[check.status]), check.name, Text(check.found))
        console.print(line)
        if check.fix:  # not wrapped, so that a command can be copied whole
            console.print(Text(" " * (NAME_WIDTH + 8) + check.fix, style="dim"), soft_wrap=True)
    num_failed = sum(check.status == "fail" for check in checks)
    if num_failed:
        console.print(f"\nThe main job cannot run yet: {num_failed} to fix, marked fail above.", style="bold red")
    else:
        console.print("\nThe main job can run: slotfilm train quick", style="green")


def check_python(version: tuple[int, ...]) -> Check:
    """Python must be one that the project supports."""
    found = ".".join(map(str, version))
    if (3, 11) <= version[:2] <= (3, 12):
        return Check(name="Python", status="ok", found=found)
    return Check(name="Python", status="fail", found=found, fix="install Python 3.11 or 3.12, then: make setup")


def check_packages(distribution: str = DISTRIBUTION) -> Check:
    """Every dependency that the installed project declares must be there in a version that it accepts."""
    from packaging.requirements import Requirement

    try:
        declared = importlib.metadata.requires(distribution) or []
    except importlib.metadata.PackageNotFoundError:
        return Check(
            name="Packages",
            status="warn",
            found=f"{distribution} is not installed, so its needs are not known",
            fix="make setup",
        )
    wrong: list[str] = []
    right: list[str] = []
    for requirement in map(Requirement, declared):
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            wrong.append(f"{requirement.name} is missing")
            continue
        if requirement.specifier.contains(version, prereleases=True):
            right.append(f"{requirement.name} {version}")
        else:
            wrong.append(f"{requirement.name} {version} is not {requirement.specifier}")
    if wrong:
        return Check(name="Packages", status="fail", found="; ".join(wrong), fix="make setup")
    return Check(name="Packages", status="ok", found=", ".join(right))


def probe_best_driver() -> tuple[VulkanProbe, VulkanProbe | None]:
    """Render with the machine's own choice of driver and, if that fails, with the software driver if there is one."""
    probe = probe_vulkan()
    software = software_driver()
    return probe, None if probe.ok or software is None else probe_vulkan(driver=software)


def check_vulkan(probe: VulkanProbe, software: VulkanProbe | None) -> Check:
    """SAPIEN must be able to render and read back a frame."""
    if probe.ok:
        found = f"{probe.device}: first frame after {probe.first_ms / 1e3:.1f} s, then {probe.frame_ms:.1f} ms"
        return Check(name="Vulkan", status="ok", found=found)
    if software is not None and software.ok:
        fix = f"VK_DRIVER_FILES={software_driver()} slotfilm train quick --env.render_backend cpu"
        found = f"{probe.cause}; software rendering works"
        return Check(name="Vulkan", status="fail", found=found, fix=f"render in software: {fix}")
    return Check(name="Vulkan", status="fail", found=probe.cause, fix=probe.fix)


def run_python(code: str) -> tuple[bool, str]:
    """Run a line of Python in a child process; returns whether it worked, and the last line that it printed."""
    try:
        child = subprocess.run(
            [sys.executable, "-P", "-c", code],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=IMPORT_TIMEOUT_S,
        )
    except subprocess.TimeoutExpired:
        return False, f"no answer within {IMPORT_TIMEOUT_S:g} s"
    lines = (child.stdout if child.returncode == 0 else child.stderr).strip().splitlines()
    return child.returncode == 0, lines[-1] if lines else f"exit status {child.returncode}"


def check_gpu() -> Check:
    """A CUDA GPU that torch can compute on; the quick preset does without."""
    code = (
        "import torch; n = torch.cuda.device_count() if torch.cuda.is_available() else 0; "
        "[torch.ones(1, device=f'cuda:{i}').item() for i in range(n)]; "
        "print(', '.join(f'{p.name} ({p.total_memory / 2**30:.0f} GiB)' "
        "for p in map(torch.cuda.get_device_properties, range(n))) or 'none')"
    )
    worked, found = run_python(code)
    if worked and found != "none":
        return Check(name="GPU", status="ok", found=found)
    if worked and shutil.which("nvidia-smi") is None:
        fix = "not needed for the presets smoke, quick and laptop; paper wants an NVIDIA GPU"
        return Check(name="GPU", status="warn", found="none: everything computes on the CPU", fix=fix)
    if worked:
        fix = "install a torch build with CUDA for this driver, or go on with --runtime.device cpu"
        return Check(name="GPU", status="warn", found="nvidia-smi is here, but torch sees no GPU", fix=fix)
    if "No module named" in found:
        return Check(name="GPU", status="fail", found=f"torch cannot be imported: {found}", fix="make setup")
    return Check(name="GPU", status="fail", found=f"torch failed: {found}", fix="--runtime.device cpu, or make setup")


def check_ray() -> Check:
    """Ray must be importable; without it only `--runtime.mode local` runs."""
    worked, found = run_python("import ray; print(ray.__version__)")
    if worked:
        return Check(name="Ray", status="ok", found=found)
    fix = "make setup, or go on without it: --runtime.mode local"
    return Check(name="Ray", status="fail", found=f"Ray cannot be imported: {found}", fix=fix)


def check_dashboards(urls: Sequence[str]) -> Check:
    """A Ray dashboard that answers without a token lets everybody who reaches it run code on the cluster."""
    states = {url: probe_dashboard(url) for url in urls}
    open_urls = [url for url, state in states.items() if state == "open"]
    if open_urls:
        found = f"{' and '.join(open_urls)} answers without a token: whoever reaches it can run code on the cluster"
        fix = (
            "stop that cluster and start it with a token: ray get-auth-token --generate; RAY_AUTH_MODE=token ray start "
            "--head --dashboard-host=127.0.0.1 (ops/security.md)"
        )
        return Check(name="Ray dashboard", status="fail", found=found, fix=fix)
    closed = [url for url, state in states.items() if state == "closed"]
    return Check(name="Ray dashboard", status="ok", found=f"{closed[0]} asks for a token" if closed else "none is open")


def check_cores(cores: float) -> Check:
    """Two cores let simulator and learner run beside each other."""
    found = f"{cores:g} ({platform.machine()})"
    if cores >= 2:
        return Check(name="Cores", status="ok", found=found)
    fix = "the quick preset takes about twice as long on one core"
    return Check(name="Cores", status="warn", found=found, fix=fix)


def check_memory(usable_gb: float, used_share: float = 0.0) -> Check:
    """The quick preset needs 6 GB, and workers on Ray a machine that is not full."""
    found = f"{usable_gb:.1f} GiB, {used_share:.0%} in use"
    if used_share > RuntimeConfig().max_memory_share:
        fix = "workers would stand still: end other programs, or see runtime.max_memory_share"
        return Check(name="Memory", status="warn", found=found, fix=fix)
    # Machines sold with 6 GB show a little less: firmware and kernel keep a share.
    if usable_gb * GIB >= 0.95 * QUICK_MEMORY_GB * 1e9:
        return Check(name="Memory", status="ok", found=found)
    fix = f"the quick preset needs {QUICK_MEMORY_GB:g} GB; the preset smoke runs with less"
    return Check(name="Memory", status="fail", found=found, fix=fix)


def check_disk(folder: Path) -> Check:
    """Run directories are written below the current folder."""
    free_gb = shutil.disk_usage(folder).free / GIB
    found = f"{free_gb:.1f} GiB free in {folder}"
    if free_gb >= AMPLE_DISK_GB:
        return Check(name="Disk", status="ok", found=found)
    if free_gb >= RUN_DISK_GB:
        fix = f"enough for the quick preset; long runs keep replay and videos and want {AMPLE_DISK_GB:g} GiB"
        return Check(name="Disk", status="warn", found=found, fix=fix)
    fix = f"free some space or run in another folder; a run needs {RUN_DISK_GB:g} GiB"
    return Check(name="Disk", status="fail", found=found, fix=fix)


def check_shared_memory(folder: Path) -> Check:
    """Ray's object store lives in shared memory; containers often have only 64 MB."""
    fix = "Ray will use slower files in /tmp; in a container give more: docker run --shm-size=2g"
    if not folder.is_dir():
        return Check(name="Shared memory", status="warn", found=f"{folder} is missing", fix=fix)
    free_gb = shutil.disk_usage(folder).free / GIB
    found = f"{free_gb:.2f} GiB free in {folder}"
    if free_gb >= SHARED_MEMORY_GB:
        return Check(name="Shared memory", status="ok", found=found)
    return Check(name="Shared memory", status="warn", found=found, fix=fix)


def check_open_files(soft: int, hard: int) -> Check:
    """Ray opens many sockets and raises the soft limit to the hard one by itself."""
    shown = ["no limit" if limit == resource.RLIM_INFINITY else str(limit) for limit in (soft, hard)]
    found = f"{shown[0]}, can be raised to {shown[1]}"
    if hard == resource.RLIM_INFINITY or hard >= OPEN_FILES:
        return Check(name="Open files", status="ok", found=found)
    fix = f"raise the limit to {OPEN_FILES} or more, for instance as root in /etc/security/limits.conf (nofile)"
    return Check(name="Open files", status="warn", found=found, fix=fix)


def ycb_folder() -> Path:
    """Where ManiSkill keeps the YCB models."""
    root = Path(os.environ.get("MS_ASSET_DIR", Path.home() / ".maniskill"))
    return root / "data" / "assets" / "mani_skill2_ycb"


def check_ycb(folder: Path) -> Check:
    """The real banana and bowl are optional; the generated ones are the default."""
    needed = ("info_pick_v0.json", "models/011_banana/textured.obj", "models/024_bowl/textured.obj")
    if all((folder / name).is_file() for name in needed):
        return Check(name="YCB models", status="ok", found=str(folder))
    fix = "only for --env.assets ycb: python -m mani_skill.utils.download_asset ycb"
    return Check(name="YCB models", status="warn", found="not installed; generated meshes are used", fix=fix)


def hub_folder() -> Path:
    """Where torch keeps downloaded weights (the same rule as `torch.hub.get_dir`)."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return Path(os.environ.get("TORCH_HOME", cache / "torch")).expanduser() / "hub"


def check_imagenet(folder: Path) -> Check:
    """ResNet-18's ImageNet weights, downloaded at first use."""
    found = sorted(folder.glob("resnet18-*.pth"))
    if found:
        return Check(name="ImageNet weights", status="ok", found=str(found[0]))
    fix = "without network: --encoder.backbone random, or --encoder.backbone path --encoder.backbone_path FILE"
    return Check(name="ImageNet weights", status="warn", found="will be downloaded at first use (45 MB)", fix=fix)


def check_physx_gpu(folder: Path, version: str, has_gpu: bool) -> Check:
    """PhysX on the GPU needs a library that SAPIEN downloads at first use."""
    found = sorted(folder.glob(f"{version or '*'}/libPhysXGpu_64.so"))
    if found:
        return Check(name="PhysX on GPU", status="ok", found=str(found[0]))
    if not has_gpu:
        return Check(name="PhysX on GPU", status="ok", found="not installed, and not needed without a GPU")
    fix = "only for --env.sim_backend gpu: SAPIEN downloads it at first use, with network"
    return Check(name="PhysX on GPU", status="warn", found="not installed", fix=fix)
