"""What the rendering probe concludes from how its child ended."""

import json
import signal
from pathlib import Path

import pytest

from slotfilm_dist.envs.vulkan_probe import diagnose_failure, device_name, probe_vulkan, read_answer

ANSWER = {"device": "llvmpipe", "first_ms": 4000.0, "frame_ms": 5.0, "physx_version": "105.1", "contrast": 0.2}


def test_answer_is_read_past_the_renderer_s_own_output() -> None:
    probe = read_answer(f"[svulkan2] [warning] noise\n{json.dumps(ANSWER)}\n", "", 0)
    assert probe.ok
    assert probe.device == "llvmpipe"
    assert probe.frame_ms == 5.0


def test_an_empty_picture_is_a_failure() -> None:
    probe = read_answer(json.dumps(ANSWER | {"contrast": 0.0}), "", 0)
    assert not probe.ok
    assert "empty" in probe.cause
    assert probe.fix


def test_an_answer_followed_by_a_crash_is_a_failure() -> None:
    assert not read_answer(json.dumps(ANSWER), "", -signal.SIGSEGV).ok


@pytest.mark.parametrize(
    ("errors", "returncode", "cause", "fix"),
    [
        ("RuntimeError: vk::createInstanceUnique: ErrorIncompatibleDriver", 1, "no Vulkan driver", "setup_vulkan.sh"),
        ("RuntimeError: failed to find a rendering device", 1, "Mesa 24.3", "--software"),
        ("ImportError: libX11.so.6: cannot open shared object file", 1, "libX11.so.6", "setup_vulkan.sh"),
        ("ModuleNotFoundError: No module named 'sapien'", 1, "No module named 'sapien'", "make setup"),
        ("", -signal.SIGSEGV, "crashed", "--software"),
        ("RuntimeError: ErrorDeviceLost", 1, "ErrorDeviceLost", "--software"),
        ("", 3, "exit status 3", "--software"),
    ],
)
def test_cause_and_fix_follow_from_the_error(errors: str, returncode: int, cause: str, fix: str) -> None:
    probe = diagnose_failure(errors, returncode)
    assert not probe.ok
    assert cause in probe.cause
    assert fix in probe.fix


def test_device_is_found_in_the_summary_by_its_cuda_number() -> None:
    entry = "GPU: {}\n  Supported: 1\n  Present:   0\n  cudaId:    {}\n  rayTrace:  1\n"
    summary = entry.format("NVIDIA H100", 0) + entry.format("llvmpipe (LLVM 15)", -1)
    assert device_name(summary, 0) == "NVIDIA H100"
    assert device_name(summary, -1) == "llvmpipe (LLVM 15)"
    assert device_name("", 0) == "unknown device"


def test_a_timeout_that_is_no_time_is_refused() -> None:
    with pytest.raises(ValueError, match="timeout_s = 0"):
        probe_vulkan(timeout_s=0)


@pytest.mark.render
def test_one_frame_is_rendered_on_a_named_device() -> None:
    probe = probe_vulkan()
    assert probe.ok, f"{probe.cause}; {probe.fix}"
    assert probe.device not in {"", "unknown device"}
    assert probe.physx_version


@pytest.mark.sim
def test_a_machine_without_a_driver_is_told_so() -> None:
    probe = probe_vulkan(driver=Path("/no/such/driver.json"))
    assert not probe.ok
    assert probe.cause == "no Vulkan driver is installed"


@pytest.mark.sim
def test_a_child_that_does_not_answer_in_time_is_killed_and_reported() -> None:
    probe = probe_vulkan(timeout_s=0.01)
    assert not probe.ok
    assert "hangs" in probe.cause
    assert "software" in probe.fix
