"""The doctor's verdicts, on situations made here and on this machine's own Python."""

import contextlib
import resource
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from slotfilm_dist.dashboards import dashboard_urls
from slotfilm_dist.doctor import (
    Check,
    check_cores,
    check_dashboards,
    check_disk,
    check_imagenet,
    check_memory,
    check_open_files,
    check_packages,
    check_physx_gpu,
    check_python,
    check_shared_memory,
    check_vulkan,
    check_ycb,
    hub_folder,
    is_ready,
    print_table,
    run_python,
    ycb_folder,
)
from slotfilm_dist.envs.vulkan_probe import VulkanProbe

NO_DRIVER = VulkanProbe(ok=False, cause="no Vulkan driver is installed", fix="bash ops/setup_vulkan.sh")
GOOD = VulkanProbe(ok=True, device="llvmpipe", first_ms=4000.0, frame_ms=5.0)


@pytest.mark.parametrize(
    ("version", "status"),
    [((3, 10, 9), "fail"), ((3, 11, 0), "ok"), ((3, 12, 9), "ok"), ((3, 13, 0), "fail")],
)
def test_only_python_3_11_and_3_12_pass(version: tuple[int, ...], status: str) -> None:
    assert check_python(version).status == status


def test_only_a_failed_check_stops_the_main_job() -> None:
    ok, warn, fail = (Check(name="x", status=status, found="y") for status in ("ok", "warn", "fail"))
    assert is_ready([ok, warn])
    assert not is_ready([ok, fail, warn])


def test_every_lack_comes_with_a_fix() -> None:
    lacks = [
        check_python((3, 9, 0)),
        check_packages("no-such-distribution"),
        check_vulkan(NO_DRIVER, None),
        check_vulkan(NO_DRIVER, GOOD),
        check_cores(1.0),
        check_memory(1.0),
        check_shared_memory(Path("/no/such/folder")),
        check_open_files(256, 256),
        check_ycb(Path("/no/such/folder")),
        check_imagenet(Path("/no/such/folder")),
        check_physx_gpu(Path("/no/such/folder"), "105.1", has_gpu=True),
    ]
    assert [check.name for check in lacks if check.status == "ok" or not check.fix] == []


def test_a_working_driver_passes_and_is_named() -> None:
    check = check_vulkan(GOOD, None)
    assert check.status == "ok"
    assert "llvmpipe" in check.found


def test_a_failing_gpu_driver_beside_a_working_software_driver_suggests_the_latter() -> None:
    check = check_vulkan(NO_DRIVER, GOOD)
    assert check.status == "fail"
    assert "--env.render_backend cpu" in check.fix


@pytest.mark.parametrize(("usable_gb", "status"), [(5.0, "fail"), (5.6, "ok"), (23.5, "ok")])
def test_memory_must_reach_six_gigabytes(usable_gb: float, status: str) -> None:
    assert check_memory(usable_gb).status == status


def test_memory_that_is_too_small_names_what_is_needed() -> None:
    assert "6 GB" in check_memory(3.0).fix


def test_machine_that_is_full_is_told_what_workers_would_do() -> None:
    assert check_memory(24.0, 0.5).status == "ok"
    full = check_memory(24.0, 0.95)
    assert (full.status, full.found) == ("warn", "24.0 GiB, 95% in use")
    assert "runtime.max_memory_share" in full.fix


def test_open_files_are_judged_by_what_the_limit_can_be_raised_to() -> None:
    assert check_open_files(1024, 524288).status == "ok"
    assert check_open_files(1024, resource.RLIM_INFINITY).status == "ok"
    assert check_open_files(1024, 1024).status == "warn"


def test_disk_is_measured_where_runs_are_written(tmp_path: Path) -> None:
    assert str(tmp_path) in check_disk(tmp_path).found


def test_declared_packages_are_compared_with_installed_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "sample-1.0.dist-info"
    folder.mkdir()
    needs = ["numpy>=1", "numpy>=999", "no-such-package", "neither-this; extra == 'dev'"]
    lines = ["Metadata-Version: 2.1", "Name: sample", "Version: 1.0", *(f"Requires-Dist: {need}" for need in needs)]
    (folder / "METADATA").write_text("\n".join(lines) + "\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)

    check = check_packages("sample")

    assert check.status == "fail"
    assert "no-such-package is missing" in check.found
    assert "is not >=999" in check.found
    assert "neither-this" not in check.found


def test_ycb_models_count_only_when_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MS_ASSET_DIR", str(tmp_path))
    folder = ycb_folder()
    assert folder == tmp_path / "data" / "assets" / "mani_skill2_ycb"
    for name in ("models/011_banana/textured.obj", "models/024_bowl/textured.obj", "info_pick_v0.json"):
        assert check_ycb(folder).status == "warn"
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    assert check_ycb(folder).status == "ok"


def test_imagenet_weights_are_looked_for_where_torch_keeps_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch = pytest.importorskip("torch")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    assert hub_folder() == Path(torch.hub.get_dir())
    (hub_folder() / "checkpoints").mkdir(parents=True)
    assert check_imagenet(hub_folder() / "checkpoints").status == "warn"
    (hub_folder() / "checkpoints" / "resnet18-f37072fd.pth").touch()
    assert check_imagenet(hub_folder() / "checkpoints").status == "ok"


def test_physx_library_must_be_of_the_version_in_use(tmp_path: Path) -> None:
    (tmp_path / "105.0").mkdir()
    (tmp_path / "105.0" / "libPhysXGpu_64.so").touch()
    assert check_physx_gpu(tmp_path, "105.1", has_gpu=True).status == "warn"
    assert check_physx_gpu(tmp_path, "105.0", has_gpu=True).status == "ok"
    assert check_physx_gpu(tmp_path, "105.1", has_gpu=False).status == "ok"


def test_a_crashing_child_is_a_result_and_not_an_exception() -> None:
    assert run_python("print(1); print(2)") == (True, "2")
    worked, found = run_python("import no_such_module")
    assert not worked
    assert "no_such_module" in found
    assert run_python("import os; os.abort()")[0] is False


def test_the_table_keeps_a_long_fix_on_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    fix = "word " * 40 + "end"
    print_table([Check(name="Disk", status="fail", found="full", fix=fix)])
    lines = capsys.readouterr().out.splitlines()
    assert any(fix in line for line in lines)
    assert "cannot run yet: 1" in "".join(lines)


@contextlib.contextmanager
def dashboard(status: int, body: bytes) -> Iterator[str]:
    """Something on the loopback that answers as a dashboard does; gives its address."""

    class Answer(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status if self.path == "/api/jobs/" and "Authorization" not in self.headers else 500)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *arguments: object) -> None:
            """Keep the terminal clean."""

    with HTTPServer(("127.0.0.1", 0), Answer) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


def test_dashboard_without_a_token_stops_the_main_job_and_says_how_to_close_it() -> None:
    with dashboard(200, b"[]") as open_url, dashboard(401, b"Unauthorized") as closed_url:
        check = check_dashboards([closed_url, open_url])
    assert not is_ready([check])
    assert open_url in check.found
    assert closed_url not in check.found
    assert "RAY_AUTH_MODE=token" in check.fix


@pytest.mark.parametrize(
    ("status", "body", "found"),
    [
        (401, b"Unauthorized", "asks for a token"),
        (403, b"", "asks for a token"),
        (404, b"", "none"),
        (200, b"<p>", "none"),
    ],
)
def test_dashboard_with_a_token_or_another_server_is_no_danger(status: int, body: bytes, found: str) -> None:
    with dashboard(status, body) as url:
        check = check_dashboards([url])
    assert check.status == "ok"
    assert found in check.found


def test_no_dashboard_is_no_danger() -> None:
    assert check_dashboards(["http://127.0.0.1:1"]).found == "none is open"


@pytest.mark.parametrize(
    ("address", "url"),
    [
        ("10.0.0.7:6379", "http://10.0.0.7:8265"),
        ("ray://head:10001", "http://head:8265"),
        ("http://head:9000/", "http://head:9000"),
        ("[::1]:6379", "http://[::1]:8265"),
    ],
)
def test_dashboard_is_looked_for_where_ray_address_points(address: str, url: str) -> None:
    assert dashboard_urls(address)[-1] == url
    assert dashboard_urls(address)[0] == "http://127.0.0.1:8265"


@pytest.mark.parametrize("address", ["", "auto", "local"])
def test_without_an_address_only_this_machine_is_looked_at(address: str) -> None:
    assert all(url.endswith(":8265") for url in dashboard_urls(address))
    assert len(dashboard_urls(address)) <= 2
