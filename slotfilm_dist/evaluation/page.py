"""The page of a run: one HTML file that says what was run, how well it works and what is still missing.

It holds its pictures and videos itself and asks no other server for anything, so it can be mailed and archived.
"""

import json
import os
from pathlib import Path

import numpy as np

from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import changed_fields, to_dict
from slotfilm_dist.evaluation import page_parts as html
from slotfilm_dist.evaluation.figures import draw_figures
from slotfilm_dist.evaluation.page_tables import (
    episode_table,
    evaluation_table,
    metric_table,
    reward_table,
    share,
    success_interval,
)
from slotfilm_dist.evaluation.record import Evaluation, RunRecord, read_run
from slotfilm_dist.evaluation.statistics import PairedDifference, paired_difference
from slotfilm_dist.metrics import PHASES

_MAX_VIDEO_BYTES = 3_000_000
_MACHINE_KEYS = ("command", "started_at", "python", "platform", "cpu", "gpu")
_SECTIONS = (
    ("missing", "Not in this report"),
    ("figures", "Figures"),
    ("videos", "Rollouts"),
    ("tables", "Numbers"),
    ("config", "Configuration"),
    ("origin", "Origin"),
)


def write_page(run_dir: Path) -> Path:
    """Write `report.html` of a run, finished or not, and give its path; its figures go to `figures/`.

    Raises:
        ValueError: the directory does not exist.
    """
    record = read_run(run_dir)
    figures, undrawn = draw_figures(record, run_dir / "figures")
    videos, left_out = _videos(record)
    gaps = [*record.missing, *undrawn, *left_out]
    bodies = {
        "missing": _missing(gaps),
        "config": _configuration(record),
        "videos": videos,
        "figures": "\n".join(html.picture(f.path, f.title, f.text) for f in figures),
        "tables": evaluation_table(record) + reward_table(record) + episode_table(record) + metric_table(record),
        "origin": _origin(record),
    }
    sections = [html.section(anchor, title, bodies[anchor]) for anchor, title in _SECTIONS]
    links = "".join(f'<li><a href="#{anchor}">{title}</a></li>' for anchor, title in _SECTIONS if bodies[anchor])
    name = html.escape(_title(record))
    text = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{name}</title>\n<style>\n{Path(__file__).with_name('page.css').read_text(encoding='utf-8')}</style>\n"
        f"</head>\n<body>\n{_headline(record)}\n<nav aria-label='Sections'><ul>{links}</ul></nav>\n<main>\n"
        + "\n".join(sections)
        + "\n</main>\n</body>\n</html>\n"
    )
    path = run_dir / "report.html"
    partial = run_dir / ".report.html.partial"
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)
    return path


def _title(record: RunRecord) -> str:
    if record.config is None:
        return f"Run {record.run_dir.name}"
    return f"{record.config.variant} on {record.config.env.task}, seed {record.config.seed}"


def _headline(record: RunRecord) -> str:
    started = record.versions.get("started_at")
    subtitle = f"Run {record.run_dir.name}" + (f", started {started}" if started else "")
    best, random = record.best_known, record.evaluation("random")
    difference = None
    if best and random and best.returns_by_seed.keys() & random.returns_by_seed.keys():
        difference = paired_difference(best.returns_by_seed, random.returns_by_seed, np.random.default_rng(0))
    cards = [
        _return_card(record, best, random, difference),
        _success_card(best, random),
        _position_card(record),
        _progress_card(record),
    ]
    verdict = html.paragraph(_verdict(record, best, difference), "verdict")
    return (
        f"<header><h1>{html.escape(_title(record))}</h1>{html.paragraph(subtitle, 'muted')}{_phases(record)}"
        f"{verdict}<div class='cards'>{''.join(cards)}</div></header>"
    )


def _phases(record: RunRecord) -> str:
    finished = record.final is not None
    words = [str(line["phase"]) for line in record.lines if line.get("phase") in PHASES]
    now = len(PHASES) if finished else PHASES.index(words[-1]) if words else -1
    items = []
    for index, phase in enumerate(PHASES):
        kind, note = ("done", "done") if index < now else ("now", "now") if index == now else ("", "not yet")
        items.append(f'<li class="{kind}">{phase}: {note}</li>')
    return f"<ol class='phases' aria-label='Phases of the run'>{''.join(items)}</ol>"


def _verdict(record: RunRecord, best: Evaluation | None, difference: PairedDifference | None) -> str:
    if best is None:
        return "Nothing was evaluated yet, so this page cannot say how good the policy is."
    which = "The final policy" if best is record.final else f"The policy after {html.number(best.env_steps, 0)} steps"
    if difference is None:
        return f"{which} was evaluated, but not the random policy on the same seeds: its return has no yardstick."
    low, high = difference.interval
    seeds = f"on the same {difference.num_pairs} seeds"
    if low > 0:
        return f"{which} beats the random policy {seeds}: the 95 % interval of the difference lies above 0."
    if high < 0:
        return f"{which} is worse than the random policy {seeds}: the 95 % interval of the difference lies below 0."
    return f"{which} cannot be told from the random policy {seeds}: the 95 % interval of the difference contains 0."


def _return_card(
    record: RunRecord, best: Evaluation | None, random: Evaluation | None, difference: PairedDifference | None
) -> str:
    title = "Return of an episode (unscaled)"
    if best is None:
        return html.card(title, "not evaluated", [])
    notes = [f"± {html.number(best.std_return)} s.d. over {len(best.episodes)} episodes"]
    if record.config:
        scale = record.config.sac.reward_scale
        notes.append(f"at reward scale {scale:g}: {html.number(best.mean_return * scale, 0)}")
    if random:
        notes.append(f"random policy: {html.number(random.mean_return)}")
    quality = ""
    if difference:
        low, high = difference.interval
        notes.append(
            f"difference {html.signed(difference.mean)}, 95 % interval {html.interval(low, high)}; "
            f"better on {difference.num_better} of {difference.num_pairs} seeds"
        )
        quality = "good" if low > 0 else "bad" if high < 0 else ""
    return html.card(title, html.number(best.mean_return), notes, quality)


def _success_card(best: Evaluation | None, random: Evaluation | None) -> str:
    title = "Success at the end of the episode"
    if best is None:
        return html.card(title, "not evaluated", [])
    notes = [
        f"{sum(e.success_at_end for e in best.episodes)} of {len(best.episodes)} episodes",
        f"95 % Wilson interval {success_interval(best)}",
        f"at some step: {share(best, 'success_once')}, grasped: {share(best, 'grasped_once')}",
    ]
    if random:
        notes.append(f"random policy: {html.percent(random.success_rate)} {success_interval(random)}")
    clear = random is not None and best.success_interval[0] > random.success_interval[1]
    return html.card(title, html.percent(best.success_rate), notes, "good" if clear else "")


def _position_card(record: RunRecord) -> str:
    title = "Position error, held-out frames"
    error, baseline = record.last("pretrain_position_error_px"), record.last("pretrain_baseline_error_px")
    auroc = record.last("pretrain_visibility_auroc")
    if error is None:
        return html.card(title, "not measured", ["Written by pre-training; variants without slots have none."])
    notes = [f"visibility AUROC {auroc:.3f} (chance 0.5)"] if auroc is not None else []
    if baseline is None:
        return html.card(title, f"{error:.1f} px", notes)
    notes.insert(0, f"predicting the mean position: {baseline:.1f} px")
    return html.card(title, f"{error:.1f} px", notes, "good" if error < baseline else "bad")


def _progress_card(record: RunRecord) -> str:
    steps, updates, seconds = (record.last(name) or 0.0 for name in ("env_steps", "updates", "time_s"))
    notes = [f"{html.number(updates, 0)} updates", f"{len(record.learning_episodes)} training episodes"]
    if record.config:
        total = record.config.schedule.total_steps
        notes.insert(0, f"of {html.number(total, 0)} planned ({html.percent(steps / total)})")
    if seconds:
        notes.append(f"{html.duration(seconds)}, {html.number(steps / seconds)} steps/s over all phases")
    return html.card("Environment steps", html.number(steps, 0), notes)


def _missing(gaps: list[str]) -> str:
    return html.bullets(gaps).replace("<ul>", '<ul class="missing">', 1)


def _configuration(record: RunRecord) -> str:
    if record.config is None:
        return ""
    changed = changed_fields(RunConfig(), record.config)
    rows = [(name, _plain(value), _plain(default)) for name, (default, value) in changed.items()]
    differences = html.table(("field", "this run", "default"), rows, "Fields that differ from the defaults.")
    return (differences or html.paragraph("Every field has its default value.")) + html.folded(
        "Full configuration", html.code(json.dumps(to_dict(record.config), indent=2))
    )


def _plain(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _videos(record: RunRecord) -> tuple[str, list[str]]:
    parts, left_out = [], []
    for path in record.videos:
        size = path.stat().st_size
        if size > _MAX_VIDEO_BYTES:
            left_out.append(
                f"videos/{path.name}: {size / 1e6:.1f} MB is too large for this page (3 MB); it lies beside it."
            )
            continue
        parts.append(
            html.video(path, None, f"{path.stem}: camera with predicted (x) and true (o) positions, attention")
        )
        strip = path.with_suffix(".png")
        if strip.exists():
            parts.append(html.picture(strip, path.stem, "Evenly spaced pictures of the episode, left to right."))
    return "\n".join(parts), left_out


def _origin(record: RunRecord) -> str:
    if not record.versions:
        return ""
    flat = dict(record.versions)
    packages = flat.pop("packages", {}) | {k: v for k, v in flat.items() if k not in _MACHINE_KEYS}
    command = str(flat.get("command", ""))
    machine = [(key.replace("_", " "), str(flat[key])) for key in _MACHINE_KEYS[1:] if flat.get(key)]
    if record.config:
        machine.append(("seed", str(record.config.seed)))
    listed = [(str(name), str(version)) for name, version in sorted(packages.items())]
    return (
        (html.paragraph("The command that made this run:") + html.code(command) if command else "")
        + html.table(("machine", ""), machine)
        + html.folded("Package versions", html.table(("package", "version"), listed))
    )
