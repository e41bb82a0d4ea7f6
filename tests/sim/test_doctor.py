"""The doctor's whole report on this machine."""

import json

import pytest

from slotfilm_dist.doctor import run_doctor

pytestmark = pytest.mark.sim


@pytest.mark.render
def test_report_for_machines_agrees_with_the_exit_status(capsys: pytest.CaptureFixture[str]) -> None:
    status = run_doctor(json=True)
    report = json.loads(capsys.readouterr().out)
    assert status == (0 if report["ready"] else 1)
    assert {"Python", "Packages", "Vulkan", "GPU", "Ray", "Memory"} <= {check["name"] for check in report["checks"]}
    assert all(check["status"] == "ok" or check["fix"] for check in report["checks"])
