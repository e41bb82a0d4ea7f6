"""`slotfilm perceive`: what an encoder sees in an image, a folder, a video, a webcam or an MJPEG stream (Figure 6)."""

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slotfilm_dist.commands.options import Parser, placed_on
from slotfilm_dist.config_files import load_config

if TYPE_CHECKING:
    from slotfilm_dist.evaluation.perceived_output import Output

FPS = 20
"""Pictures a second of a written video: the control rate."""


def main(arguments: Sequence[str]) -> int:
    """Perceive; gives the exit code: 1 where a live source broke off, with everything until then written."""
    options = _parser().parse_args(arguments)
    if options.timeout <= 0 or (options.seconds is not None and options.seconds <= 0):
        raise ValueError("--timeout and --seconds are in seconds and must be greater than 0")
    if options.max_frames is not None and options.max_frames < 1:
        raise ValueError(f"--max-frames {options.max_frames}: must be 1 or more")
    if not options.out and not options.show and not options.json:
        raise ValueError("nothing to do: give --out FILE or DIR, --show or --json")
    if (
        options.show
        and sys.platform == "linux"
        and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    ):
        raise ValueError("--show: there is no display here; use --out FILE or DIR")
    load_config(Path(options.checkpoint) / "config.json")

    from slotfilm_dist.evaluation.mjpeg import StreamBroken

    broken = ""
    outputs = _outputs(options)
    summary: dict[str, Any] = {}
    try:
        for so_far in _run(options, outputs):
            summary = so_far
    except StreamBroken as error:
        broken = str(error)
    finally:
        for output in outputs:
            output.close()
    if summary:
        print(
            f"{summary['pictures']} pictures, {summary['rate_hz']:.1f} a second, "
            f"{summary['latency_ms_mean']:.1f} ms each" + (f": {options.out}" if options.out else ""),
            file=sys.stderr,
        )
    if options.json:
        print(json.dumps({"source": options.source, "out": options.out, "broken": broken, **summary}))
    if broken:
        print(f"slotfilm: {broken}", file=sys.stderr)
    return 1 if broken else 0


def _parser() -> Parser:
    parser = Parser(
        prog="slotfilm perceive",
        description="Attention, positions and visibility on pictures from outside the simulator (Figure 6).",
    )
    parser.add_argument(
        "source", help="an image, a folder, a video, a webcam's number, or http://... of an MJPEG stream"
    )
    parser.add_argument("--checkpoint", required=True, metavar="RUN", help="directory of the run whose encoder looks")
    parser.add_argument(
        "--which",
        choices=("last", "best", "pretrained"),
        default="last",
        help="newest checkpoint, best during training, or the encoder as pre-trained (default: %(default)s)",
    )
    parser.add_argument("--artifacts", default="artifacts", metavar="DIR", help="where pre-trained encoders are")
    parser.add_argument(
        "--out", default="", metavar="FILE|DIR", help="write an .mp4, one .png, or a folder of .png with numbers.csv"
    )
    parser.add_argument("--show", action="store_true", help="open a window; q closes it")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="(default: %(default)s)")
    parser.add_argument("--timeout", type=float, default=5.0, help="longest wait for a picture in s (default: 5)")
    parser.add_argument("--max-frames", type=int, help="stop after so many pictures")
    parser.add_argument("--seconds", type=float, help="stop after so many seconds")
    parser.add_argument("--json", action="store_true", help="print a summary as one JSON object")
    return parser


def _outputs(options: argparse.Namespace) -> "list[Output]":
    from slotfilm_dist.evaluation.perceived_output import open_output, open_window

    out, source = Path(options.out), Path(options.source)
    if options.out and source.exists() and out.resolve() == source.resolve():
        raise ValueError(f"--out {options.out}: would overwrite what is looked at; choose another place")
    outputs = [open_output(out, FPS)] if options.out else []
    return [*outputs, open_window()] if options.show else outputs


def _run(options: argparse.Namespace, outputs: "list[Output]") -> Iterator[dict[str, Any]]:
    """Perceive one picture after another; gives the summary so far after each."""
    import torch

    from slotfilm_dist.commands.trained_agent import load_trained_agent
    from slotfilm_dist.envs.tasks import task_named
    from slotfilm_dist.evaluation.camera_sources import pictures, square
    from slotfilm_dist.evaluation.live_perception import FrameRate, draw_seen, perceive_picture, seen_row
    from slotfilm_dist.local import learner_device
    from slotfilm_dist.machine import usable_cores

    run_dir = Path(options.checkpoint)
    config = load_config(run_dir / "config.json")
    torch.set_num_threads(config.runtime.learner_threads or max(1, int(usable_cores()) // 2))
    device = learner_device(placed_on(config, options.device), "--device")
    agent = load_trained_agent(run_dir, options.which, device, Path(options.artifacts))
    encoder = agent.slots("perceive")
    objects = task_named(config.env.task).objects
    matched = config.encoder.vis_head == "matched"
    labels = [f"slot {i}" for i in range(config.encoder.num_slots)] if matched else list(objects)
    rate = FrameRate()
    latencies: list[float] = []
    for index, picture in enumerate(pictures(options.source, options.timeout)):
        seen = perceive_picture(encoder, square(picture, config.env.image_size))
        latencies.append(seen.latency_ms)
        rate.add()
        if outputs:
            drawn = draw_seen(seen, labels, f"{rate.recent_hz:.1f} Hz   {seen.latency_ms:.1f} ms")
            for output in outputs:
                output.add(drawn, seen_row(index, seen, labels))
        _show_rate(rate.count, rate.recent_hz)
        yield _summary(rate.count, rate.mean_hz, latencies)
        out_of_time = options.seconds is not None and time.monotonic() - rate.started_s >= options.seconds
        if rate.count == options.max_frames or out_of_time or any(output.closed for output in outputs):
            return


def _summary(count: int, rate_hz: float, latencies: Sequence[float]) -> dict[str, Any]:
    warm = latencies[1:] if len(latencies) > 1 else latencies
    return {"pictures": count, "rate_hz": rate_hz, "latency_ms_mean": sum(warm) / len(warm)}


def _show_rate(count: int, rate_hz: float) -> None:
    """One line that stays in place on a terminal."""
    if sys.stderr.isatty():
        print(f"\r{count} pictures, {rate_hz:.1f} a second ", end="", file=sys.stderr, flush=True)
