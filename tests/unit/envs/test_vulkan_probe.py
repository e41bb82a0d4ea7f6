"""What the rendering probe concludes from how its child ended."""

import json
import signal

import pytest

from slotfilm_dist.envs.vulkan_probe import device_name, diagnose_failure, probe_vulkan, read_answer

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
