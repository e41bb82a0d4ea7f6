"""The rendering probe on this machine."""

from pathlib import Path

import pytest

from slotfilm_dist.envs.vulkan_probe import probe_vulkan

pytestmark = pytest.mark.sim


@pytest.mark.render
def test_one_frame_is_rendered_on_a_named_device() -> None:
    probe = probe_vulkan()
    assert probe.ok, f"{probe.cause}; {probe.fix}"
    assert probe.device not in {"", "unknown device"}
    assert probe.physx_version


def test_a_machine_without_a_driver_is_told_so() -> None:
    probe = probe_vulkan(driver=Path("/no/such/driver.json"))
    assert not probe.ok
    assert probe.cause == "no Vulkan driver is installed"


def test_a_child_that_does_not_answer_in_time_is_killed_and_reported() -> None:
    probe = probe_vulkan(timeout_s=0.01)
    assert not probe.ok
    assert "hangs" in probe.cause
    assert "software" in probe.fix
