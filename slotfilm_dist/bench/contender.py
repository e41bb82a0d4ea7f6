"""The parent's side of a contender in a process of its own, with the threads that it is given and no more."""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

from slotfilm_dist.bench.results import BenchResult, not_measured

ROOT = Path(__file__).resolve().parents[2]
PEERS_PYTHON = ROOT / ".peers" / "bin" / "python"
START_S = 300.0
"""Longest time until a contender is built; simulators and Ray take their time on a busy machine."""
ANSWER_S = 600.0
"""Longest time for one measurement."""


class ContenderError(RuntimeError):
    """A contender could not be measured; the text says why."""


class Contender:
    """A child process that is built once and then asked again and again.

    Args:
        module: dotted name below `slotfilm_dist.bench` that calls `serving.serve`.
        arguments: of its `build`.
        peer: run it by the peers' environment, else by this one.
        threads: for torch, BLAS and the software renderer's own.

    Raises:
        ContenderError: it could not be built.
    """

    def __init__(self, module: str, arguments: dict[str, Any], *, peer: bool = False, threads: int = 1) -> None:
        if peer and not PEERS_PYTHON.exists():
            raise ContenderError("the peers' environment is missing; `make bench-peers` installs it")
        self._name = module
        self._log = tempfile.TemporaryFile("w+")  # noqa: SIM115  closed with the child
        self._child = subprocess.Popen(
            [PEERS_PYTHON if peer else sys.executable, "-m", f"slotfilm_dist.bench.{module}", json.dumps(arguments)],
            cwd=ROOT,
            env=_environment(threads),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
        )
        try:
            self._answer(START_S)
        except ContenderError:
            self.close()
            raise

    def ask(self, method: str = "measure", **arguments: Any) -> Any:
        """A method's result; raises `ContenderError` if there is none."""
        self.begin(method, **arguments)
        return self.result()

    def begin(self, method: str = "measure", **arguments: Any) -> None:
        """Ask, and let it work; `result` waits for it."""
        assert self._child.stdin is not None
        try:
            self._child.stdin.write(json.dumps({"method": method, "arguments": arguments}) + "\n")
            self._child.stdin.flush()
        except BrokenPipeError:
            raise ContenderError(f"{self._name} ended: {self._last_words()}") from None

    def result(self) -> Any:
        """The result of `begin`."""
        return self._answer(ANSWER_S)

    def close(self) -> None:
        """End the process."""
        if self._child.stdin is not None and not self._child.stdin.closed:
            with contextlib.suppress(BrokenPipeError):
                self._child.stdin.close()
        try:
            self._child.wait(20)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        if self._child.stdout is not None:
            self._child.stdout.close()
        self._log.close()

    def __enter__(self) -> "Contender":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _answer(self, timeout_s: float) -> Any:
        assert self._child.stdout is not None
        # Ends a child that takes too long, which ends the line that is waited for.
        alarm = threading.Timer(timeout_s, self._child.kill)
        alarm.start()
        try:
            line = self._child.stdout.readline()
        finally:
            alarm.cancel()
        if not line:
            raise ContenderError(f"{self._name} ended or took longer than {timeout_s:g} s: {self._last_words()}")
        answer = json.loads(line)
        if "error" in answer:
            raise ContenderError(f"{self._name}: {answer['error']}")
        return answer["value"]

    def _last_words(self) -> str:
        self._log.seek(0)
        lines = [line.strip() for line in self._log.read().splitlines() if line.strip()]
        return lines[-1] if lines else "it said nothing"


def missing(name: str, goal: float | None, unit: str, error: ContenderError) -> BenchResult:
    """The row of a contender that could not be measured."""
    return not_measured(name, goal, unit, str(error))


def _environment(threads: int) -> dict[str, str]:
    counts = {name: str(threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    # The software renderer draws in its caller's thread with 0, with so many of its own otherwise.
    return os.environ | counts | {"LP_NUM_THREADS": "0" if threads == 1 else str(threads)}
