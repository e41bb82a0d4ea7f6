"""Can SAPIEN render here? Answered by rendering one frame in a child process and reading it back.

A missing or unsuitable Vulkan driver shows itself in many ways: an exception, a crash in native code, a read-back that
never returns, or a black picture. A child process under a timeout survives all of them. Run as a file, this module is
that child.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ICD_DIRECTORIES = ("/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d")
SETUP = "bash ops/setup_vulkan.sh"
SETUP_SOFTWARE = f"{SETUP} --software"
PICTURE_SIZE = 64


@dataclass(frozen=True, kw_only=True, slots=True)
class VulkanProbe:
    """What became of the attempt to render one frame."""

    ok: bool
    """The frame was rendered, read back and shows what it should."""
    device: str = ""
    """Name of the rendering device; empty where the child did not get that far."""
    first_ms: float = 0.0
    """Time to the first picture in milliseconds, with building the pipelines."""
    frame_ms: float = 0.0
    """Time of one more picture in milliseconds, read-back included."""
    physx_version: str = ""
    """Version of PhysX in SAPIEN; the PhysX GPU library is kept in a folder of this name."""
    cause: str = ""
    """Why it did not work; empty if it did."""
    fix: str = ""
    """What to do about it; empty if it worked."""


def software_driver() -> Path | None:
    """The manifest of Mesa's software Vulkan driver (lavapipe), or None where it is not installed."""
    found = (path for folder in ICD_DIRECTORIES for path in sorted(Path(folder).glob("lvp_icd*.json")))
    return next(found, None)


def probe_vulkan(timeout_s: float = 60.0, driver: Path | None = None) -> VulkanProbe:
    """Render one frame with SAPIEN in a child process and read it back.

    Args:
        timeout_s: Longest wait for the child in seconds; it is then killed with all it started.
        driver: Manifest of the only Vulkan driver to offer; None leaves the choice to the machine.
    """
    if not timeout_s > 0:
        raise ValueError(f"timeout_s = {timeout_s!r}: must be greater than 0 seconds")
    command = [sys.executable, "-P", __file__]
    if driver is not None:
        command = ["env", f"VK_DRIVER_FILES={driver}", f"VK_ICD_FILENAMES={driver}", *command]
    child = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,
    )
    try:
        output, errors = child.communicate(timeout=timeout_s)
    except subprocess.TimeoutExpired:
        return diagnose_hang(timeout_s, software_driver() if driver is None else driver)
    finally:
        kill_session(child)
    return read_answer(output, errors, child.returncode)


def kill_session(child: subprocess.Popen[str]) -> None:
    """Kill the child and all it started, and wait until it is gone; does nothing once it has ended."""
    if child.poll() is None:
        os.killpg(child.pid, signal.SIGKILL)
        child.communicate()


def read_answer(output: str, errors: str, returncode: int) -> VulkanProbe:
    """Turn what the child printed, and how it ended, into a result."""
    lines = [line for line in output.splitlines() if line.startswith("{")]
    if returncode != 0 or not lines:
        return diagnose_failure(errors, returncode)
    answer: dict[str, Any] = json.loads(lines[-1])
    contrast = answer.pop("contrast")
    if contrast < 0.01:
        return VulkanProbe(
            ok=False,
            cause=f"the rendered picture is empty (standard deviation {contrast:.4f} instead of about 0.2)",
            fix=f"the Vulkan driver of {answer['device']!r} is faulty: update it, or render in software "
            f"({SETUP_SOFTWARE})",
            **answer,
        )
    return VulkanProbe(ok=True, **answer)


def diagnose_hang(timeout_s: float, software: Path | None) -> VulkanProbe:
    """Name the cause and the fix of a child that did not come back."""
    fix = "try again when the machine is less busy"
    if software is not None:
        fix += f", or render in software: VK_DRIVER_FILES={software} and --env.render_backend cpu"
    else:
        fix += f", or render in software: {SETUP_SOFTWARE}"
    return VulkanProbe(
        ok=False, cause=f"no picture came back within {timeout_s:g} s: the Vulkan driver hangs in read-back", fix=fix
    )


def diagnose_failure(errors: str, returncode: int) -> VulkanProbe:
    """Name the cause and the fix of a child that failed, from its error output and exit status."""
    lines = [line.strip() for line in errors.splitlines() if line.strip()]
    last = lines[-1] if lines else f"exit status {returncode}"
    if missing := re.search(r"(lib\S+\.so\S*): cannot open shared object", errors):
        cause, fix = f"the system library {missing[1]} is missing", SETUP
    elif "No module named" in last:
        cause, fix = f"SAPIEN cannot be imported: {last}", "make setup"
    elif re.search(r"ErrorIncompatibleDriver|does not support Vulkan", errors):
        cause, fix = "no Vulkan driver is installed", SETUP
    elif re.search(r"failed to find a rendering device|semaphore", errors):
        cause = "the installed Vulkan driver is too old for SAPIEN (software rendering needs Mesa 24.3 or newer)"
        fix = SETUP_SOFTWARE
    elif returncode < 0:
        cause = f"the Vulkan driver crashed ({signal.strsignal(-returncode)})"
        fix = f"update the driver, or render in software: {SETUP_SOFTWARE}"
    else:
        cause, fix = f"SAPIEN cannot render: {last}", SETUP_SOFTWARE
    return VulkanProbe(ok=False, cause=cause, fix=fix)


def render_one_frame() -> dict[str, str | float]:
    """Render a lit box with SAPIEN on the device ManiSkill would take, and measure it (the child's work)."""
    import sapien

    start = time.perf_counter()
    try:
        render = sapien.render.RenderSystem(sapien.Device("cuda"))
    except RuntimeError:  # SAPIEN sees no CUDA device: ManiSkill falls back to this one as well
        render = sapien.render.RenderSystem(sapien.Device("cpu"))
    sapien.render.set_camera_shader_dir("minimal")
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem(), render])
    scene.set_ambient_light([0.5, 0.5, 0.5])
    box = scene.create_actor_builder()
    box.add_box_visual(half_size=(0.2, 0.2, 0.2), material=sapien.render.RenderMaterial(base_color=[1, 0.2, 0.1, 1]))
    box.build_kinematic("box")
    camera = scene.add_camera("camera", PICTURE_SIZE, PICTURE_SIZE, fovy=1.5, near=0.01, far=10.0)
    camera.entity.set_pose(sapien.Pose([-1.0, 0.0, 0.0]))
    scene.update_render()
    camera.take_picture()
    picture = camera.get_picture("Color")
    first = time.perf_counter()
    camera.take_picture()
    camera.get_picture("Color")
    second = time.perf_counter()
    cuda_id = render.device.cuda_id if render.device.is_cuda() else -1
    return {
        "device": device_name(sapien.render.get_device_summary(), cuda_id),
        "first_ms": 1e3 * (first - start),
        "frame_ms": 1e3 * (second - first),
        "physx_version": sapien.physx.version(),
        "contrast": float(picture[..., :3].std()),
    }


def device_name(summary: str, cuda_id: int) -> str:
    """The name that SAPIEN's device summary gives the device of a CUDA id; -1 is a device without one."""
    found = re.findall(r"GPU:\s*(.+?)\s*\n.*?cudaId:\s*(-?\d+)", summary, flags=re.DOTALL)
    return next((name for name, number in found if int(number) == cuda_id), "unknown device")


if __name__ == "__main__":
    print(json.dumps(render_one_frame()), flush=True)
