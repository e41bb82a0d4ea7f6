"""Turns a command line into a run's config: preset, then task, then variant, then single fields."""

import argparse
import contextlib
import dataclasses
import difflib
import io
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import NoReturn

from slotfilm_dist.commands.effects import check_effects
from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import from_dict, to_dict
from slotfilm_dist.presets import PRESETS, preset_named
from slotfilm_dist.variants import VARIANTS, apply_variant
from slotfilm_dist.weights_file import weights_file_sha256

TOP_FIELDS = tuple(field.name for field in dataclasses.fields(RunConfig))
FIELDS_NOTE = (
    "Every field of the config is an option too, as in --sac.temperature 0.2; `--fields` lists them all. They \
change the proposed agent, and a variant is its difference from that."
)


class Parser(argparse.ArgumentParser):
    """Refuses with one sentence and exit code 2."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message}; see `{self.prog} --help`")


def episode_seeds(first: int, episodes: int) -> range:
    """One seed an episode, from `--seed` on; raises ``ValueError`` where the simulator could not take them all."""
    if not 0 <= first <= (1 << 31) - episodes:
        raise ValueError(f"--seed {first}: must lie between 0 and {(1 << 31) - episodes}")
    return range(first, first + episodes)


def parse_with_fields(parser: Parser, arguments: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """The parser's own options, and the config fields among them: `--section.field` with the values that follow it."""
    own: list[str] = []
    fields: list[str] = []
    target = own
    for word in arguments:
        if word.startswith("--"):
            name = word.split("=")[0]
            section = name[2:].split(".")[0].replace("-", "_")
            if name not in parser._option_string_actions and "." not in name and section not in TOP_FIELDS:
                known = [*parser._option_string_actions, *(f"--{field}" for field in _field_names(RunConfig(), ""))]
                near = difflib.get_close_matches(name, known, n=1)
                parser.error(f"unknown option {name}" + (f"; did you mean {near[0]}?" if near else ""))
            target = own if name in parser._option_string_actions else fields
        elif word.startswith("-") and not _is_number(word):
            target = own
        target.append(word)
    return parser.parse_args(own), fields


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def add_config_options(parser: argparse.ArgumentParser, preset: str) -> None:
    """Preset, variant, seed and the note on fields."""
    parser.add_argument("preset", nargs="?", default=preset, help=f"budget: {', '.join(PRESETS)} (default: {preset})")
    parser.add_argument("--variant", default="", help=f"agent: {', '.join(VARIANTS)} (default: slotfilm)")
    parser.add_argument("--fields", action="store_true", help="list every field of the config with its default")
    parser.epilog = FIELDS_NOTE


def add_device_option(parser: argparse.ArgumentParser) -> None:
    """Where a trained run's networks compute, for `placed_on`."""
    parser.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), help="where networks compute (default: as the run was trained)"
    )


def placed_on(config: RunConfig, device: str | None) -> RunConfig:
    """The config, computing on this device instead of its own if one is named."""
    return replace(config, runtime=replace(config.runtime, device=device or config.runtime.device))


def build_config(preset: str, variant: str, fields: Sequence[str], *, show_fields: bool = False) -> RunConfig:
    """The config that a command line asks for: the variant of the preset's agent with these fields, as in a grid.

    Args:
        preset: name of the budget.
        variant: name of the agent; empty for the preset's own.
        fields: what remains of the command line, `--section.field value`.
        show_fields: print every field and exit instead.

    Raises:
        ValueError: an unknown name (with the nearest known one), an impossible value, or a field without effect.
    """
    from slotfilm_dist.envs.tasks import adapt_config

    base = preset_named(preset)
    task = _value_of(fields, "--env.task")
    if task:
        base = replace(base, env=replace(base.env, task=task))
    base = adapt_config(base)
    plain = apply_variant(variant or base.variant, base)
    if show_fields:
        change_fields(plain, ["--help"])
    try:
        changed = change_fields(base, fields)
        config = apply_variant(plain.variant, changed)
    except ValueError:  # what the proposed agent cannot have the variant may: views of a picture, its own width
        changed = config = change_fields(plain, fields)
    check_effects(fields, plain, changed, config)
    return config


def change_fields(base: RunConfig, fields: Sequence[str]) -> RunConfig:
    """The config with single fields changed, `--section.field value`.

    Raises:
        ValueError: an unknown field (with the nearest known one) or an impossible value.
    """
    import tyro

    shown = io.StringIO()
    try:
        with contextlib.redirect_stderr(shown):
            changed = tyro.cli(RunConfig, default=base, args=fields, prog="slotfilm train", use_underscores=True)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise ValueError(_refusal(fields, shown.getvalue())) from None
    return from_dict(RunConfig, to_dict(changed))


def with_weights_file(config: RunConfig) -> RunConfig:
    """The config with the SHA-256 of its file of initial weights, read before anything heavy is imported or started.

    On the cluster of `RAY_ADDRESS` the file lies where the learner runs, which looks for it itself.

    Raises:
        ValueError: the file cannot be read, or is not the one that `encoder.backbone_sha256` names.
    """
    encoder = config.encoder
    if encoder.backbone != "path" or not encoder.uses_image or os.environ.get("RAY_ADDRESS"):
        return config
    return replace(config, encoder=replace(encoder, backbone_sha256=weights_file_sha256(encoder)))


def _refusal(fields: Sequence[str], shown: str) -> str:
    """One sentence of what tyro has to say in a box."""
    known = _field_names(RunConfig(), "")
    for field in fields:
        name = field.removeprefix("--").split("=")[0].replace("-", "_")
        if field.startswith("--") and name.replace(".no_", ".") not in known:
            near = difflib.get_close_matches(name, known, n=1)
            return f"unknown field --{name}" + (f"; did you mean --{near[0]}?" if near else "; --fields lists them all")
    lines = [line.strip(" |│╭╮╰╯─\n") for line in shown.splitlines()]
    text = " ".join(line for line in lines if line and "--help" not in line)
    text = re.sub(r"[-─]{4,}", "", text).strip()
    if text.startswith("Unrecognized options"):
        return f"{text}; the preset comes first, and no_ turns a yes/no field off, as in --obs.no_normalize_state"
    text = re.sub(r"^(Invalid choice|Missing argument|Value error)\s+", "", text)
    match = re.search(r"Error parsing (\S+): (.*?)(?: Argument helptext:.*)?$", text)
    if match is None:
        return text
    where, what = match.groups()
    return f"{where}: {what}" if where.startswith("--") else what


def _field_names(config: object, where: str) -> list[str]:
    names: list[str] = []
    for field in dataclasses.fields(config):  # type: ignore[arg-type]  # a config section
        value = getattr(config, field.name)
        name = where + field.name
        names += _field_names(value, name + ".") if dataclasses.is_dataclass(value) else [name]
    return names


def _value_of(fields: Sequence[str], option: str) -> str:
    for index, field in enumerate(fields):
        if field.startswith(option + "="):
            return field.split("=", 1)[1]
        if field == option and index + 1 < len(fields):
            return fields[index + 1]
    return ""
