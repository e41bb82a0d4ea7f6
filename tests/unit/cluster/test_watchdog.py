"""What a private cluster leaves is ended and deleted however its driver ends, and nothing else is touched."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from slotfilm_dist.cluster import watchdog as watchdog_module
from slotfilm_dist.cluster.watchdog import MARK, end_members, members

SLEEPER = "import sys; print('up', flush=True); sys.stdin.read()"
DRIVER = f"""
import os, subprocess, sys
from pathlib import Path
from slotfilm_dist.cluster.watchdog import MARK, Watchdog
folder = Path(sys.argv[1])
watchdog = Watchdog(folder)
os.environ[MARK] = str(folder)
own = subprocess.Popen([sys.executable, "-c", {SLEEPER!r}, f"{{folder}}/log"], stdin=subprocess.PIPE, stdout=2)
print(own.pid, watchdog._process.pid, flush=True)
sys.stdin.read(1)
watchdog.close()
print("closed", flush=True)
sys.stdin.read()
"""
Start = Callable[..., psutil.Process]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "slotfilm-mine"
    made.mkdir()
    (made / "owner").touch()
    return made


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts processes that live until the test ends."""
    started: list[subprocess.Popen[str]] = []

    def start(
        *words: object, mark: Path | None = None, output: Path | None = None, reads: Path | None = None
    ) -> psutil.Process:
        with contextlib.ExitStack() as files:
            stderr = files.enter_context(output.open("w")) if output else None
            log = [files.enter_context(reads.open()).fileno()] if reads else []
            process = subprocess.Popen(
                [sys.executable, "-c", SLEEPER, *map(str, words)],
                env=os.environ | ({MARK: str(mark)} if mark else {}),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                pass_fds=log,
                text=True,
            )
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        return psutil.Process(process.pid)

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture
def driver(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A driver with a watchdog and a process of its cluster."""
    process = subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    yield process
    process.kill()
    process.communicate()


def running_after(processes: list[psutil.Process], timeout_s: float) -> list[psutil.Process]:
    """Those that do not end in time. A zombie has ended; who adopted it may take its time to ask how."""
    deadline = time.monotonic() + timeout_s
    while True:
        left = []
        for process in processes:
            with contextlib.suppress(psutil.NoSuchProcess):
                if process.is_running() and process.status() != psutil.STATUS_ZOMBIE:
                    left.append(process)
        if not left or time.monotonic() > deadline:
            return left
        time.sleep(0.05)


def started_by(driver: subprocess.Popen[str]) -> tuple[psutil.Process, psutil.Process]:
    assert driver.stdout is not None
    own, watchdog = map(int, driver.stdout.readline().split())
    return psutil.Process(own), psutil.Process(watchdog)


def test_members_are_those_that_write_in_the_folder_or_are_marked_and_name_it(
    folder: Path, tmp_path: Path, start: Start
) -> None:
    other = tmp_path / "slotfilm-mine-too"
    other.mkdir()
    named = start(f"--log_dir={folder}/ray/logs", mark=folder)
    writer = start("without a mark, for its title has overwritten it", output=folder / "worker.err")
    start(f"--log_dir={other}/ray", mark=other, output=other / "worker.err")
    start(f"{folder}/worker.err", reads=folder / "worker.err")
    start("tensorboard", mark=folder)
    assert set(members(folder)) == {named, writer}
    assert members(folder, spared=[named.pid]) == [writer]


def test_only_members_are_killed(folder: Path, tmp_path: Path, start: Start) -> None:
    mine = [start(f"{folder}/a", mark=folder) for _ in range(2)]
    other = start(f"{tmp_path}/slotfilm-other/a", mark=tmp_path / "slotfilm-other")
    assert end_members(folder) == 2
    psutil.wait_procs(mine, 10)
    assert [process.is_running() and process.status() != psutil.STATUS_ZOMBIE for process in mine] == [False, False]
    assert other.is_running()


def test_killed_driver_leaves_no_process_and_no_folder(
    driver: subprocess.Popen[str], folder: Path, start: Start
) -> None:
    bystander = start(f"{folder}/a")
    own, watchdog = started_by(driver)
    driver.kill()
    assert running_after([own, watchdog], 10) == []
    assert not folder.exists()
    assert bystander.is_running()


def test_end_of_pipe_in_other_hands_does_not_keep_it_from_noticing(driver: subprocess.Popen[str], folder: Path) -> None:
    own, watchdog = started_by(driver)
    # As a child that the driver has forked would: it has every descriptor of the driver's.
    held = [os.open(f"/proc/{driver.pid}/fd/{number}", os.O_WRONLY) for number in pipe_ends(driver.pid, watchdog.pid)]
    assert held
    driver.kill()
    alive = running_after([own, watchdog], 10)
    for descriptor in held:
        os.close(descriptor)
    assert alive == []


def pipe_ends(holder: int, reader: int) -> list[str]:
    """Descriptors of a process that are the other end of a second one's standard input."""
    pipe = os.readlink(f"/proc/{reader}/fd/0")
    links = Path(f"/proc/{holder}/fd")
    return [link.name for link in links.iterdir() if os.readlink(link) == pipe]


def test_interrupt_of_the_drivers_group_leaves_the_watchdog_to_its_work(
    driver: subprocess.Popen[str], folder: Path
) -> None:
    own, watchdog = started_by(driver)
    assert os.getpgid(watchdog.pid) == os.getsid(watchdog.pid) == watchdog.pid
    os.killpg(driver.pid, signal.SIGKILL)
    assert running_after([own, watchdog], 10) == []
    assert not folder.exists()


def test_ordinary_shutdown_ends_it_and_spares_the_driver(driver: subprocess.Popen[str], folder: Path) -> None:
    own, watchdog = started_by(driver)
    assert driver.stdin is not None
    assert driver.stdout is not None
    driver.stdin.write("x")
    driver.stdin.flush()
    assert driver.stdout.readline() == "closed\n"
    assert not watchdog.is_running()
    assert running_after([own], 1) == []
    assert not folder.exists()
    assert driver.poll() is None


def test_its_process_has_nothing_large_loaded() -> None:
    program = "import runpy, sys; runpy.run_path(sys.argv[1]); print(*sys.modules)"
    command = [sys.executable, "-P", "-c", program, watchdog_module.__file__]
    loaded = set(subprocess.check_output(command, cwd="/", text=True, timeout=60).split())
    assert "psutil" in loaded
    assert not loaded & {"torch", "ray", "numpy"}


def test_member_is_known_by_files_that_have_been_deleted(folder: Path, start: Start) -> None:
    renamed = start("ray::DashboardAgent", mark=folder, output=folder / "agent.err")
    (folder / "agent.err").unlink()
    assert members(folder) == [renamed]


def test_what_a_look_finds_is_killed_even_if_it_took_all_the_time(folder: Path, start: Start) -> None:
    mine = start(f"{folder}/a", mark=folder)
    assert end_members(folder, timeout_s=0.0) == 1
    psutil.wait_procs([mine], 10)
    assert not mine.is_running() or mine.status() == psutil.STATUS_ZOMBIE
