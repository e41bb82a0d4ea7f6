"""A run that was trained on a GPU is measured where there is none."""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from slotfilm_dist.__main__ import main
from slotfilm_dist.commands.evaluate_parts import load
from slotfilm_dist.presets import smoke
from slotfilm_dist.variants import apply_variant


@pytest.fixture
def run(tmp_path: Path, write_agent_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run whose config asks for a GPU, on a machine without one."""
    base = apply_variant("state_only", smoke())
    path = write_agent_run(
        tmp_path / "run", replace(base, runtime=replace(base.runtime, device="cuda", learner_threads=1))
    )
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    return path


@pytest.mark.parametrize(
    "words",
    [
        ("evaluate", "RUN"),
        ("evaluate", "RUN", "--policy", "random"),
        ("evaluate", "RUN", "--what", "robustness"),
        ("evaluate", "RUN", "--device", "cuda"),
        ("probe", "RUN"),
        ("perceive", "a.png", "--checkpoint", "RUN", "--json", "--device", "cuda"),
    ],
)
def test_refusal_names_an_option_that_the_command_has(
    run: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    assert main([str(run) if word == "RUN" else word for word in words]) == 2
    assert capsys.readouterr().err.endswith("torch finds no CUDA GPU here; use --device cpu or auto\n")


@pytest.mark.parametrize("device", ["cpu", "auto"])
def test_named_device_takes_the_place_of_the_runs_own(run: Path, device: str) -> None:
    options = argparse.Namespace(run=str(run), checkpoint="last", artifacts="artifacts", device=device)
    agent = load(options)
    assert {tensor.device.type for tensor in agent.encoder.state_dict().values()} == {"cpu"}
    assert agent.config.runtime.device == "cuda"  # what the run is stays as it was
