"""Refuses fields of a command line that would change nothing, before a run goes by another name than its own."""

from collections.abc import Sequence
from functools import reduce

from slotfilm_dist.config import RunConfig, check

UNREAD_BY_DDPG = ("lr.", "sac.tau", "sac.hidden", "sac.critic_norm", "sac.temperature", "sac.final_temperature")
UNREAD_BY_DDPG += ("sac.annealing_updates", "sac.target_entropy", "sac.log_std_min", "sac.log_std_max", "sac.augment_")
"""What DrQ-v2's algorithm has its own of, in `ddpg`, or nothing like it."""
OF_PICK_BANANA = ("reward.", "success.", "env.goal", "env.assets")
"""What only a task reads whose reward and scene are ours."""


def check_effects(fields: Sequence[str], plain: RunConfig, changed: RunConfig, config: RunConfig) -> None:
    """Raise ``ValueError`` if a field that the command line names is overridden by the variant or read by nobody.

    Args:
        fields: of the command line, `--section.field value`.
        plain: the variant without them.
        changed: the proposed agent with them.
        config: the variant with them.
    """
    from slotfilm_dist.envs.tasks import check_goal, objection, task_named

    task = task_named(config.env.task)
    wanted = len(task.objects)
    check(config.obs.num_objects == wanted, "obs.num_objects", config.obs.num_objects, f"{task.env_id} has {wanted}")
    for name in _named(fields, changed):
        value, got = _value(changed, name), _value(config, name)
        if got != value and got == _value(plain, name):
            raise ValueError(
                f"--{name}: the variant {config.variant!r} always has {name} = {got!r}; leave one of the two away"
            )
        if config.algorithm == "ddpg" and name.startswith(UNREAD_BY_DDPG):
            raise ValueError(f"--{name}: the variant {config.variant!r} does not read it; its own fields are --ddpg.*")
        if not task.own_reward and name.startswith(OF_PICK_BANANA):
            raise ValueError(f"--{name}: {task.env_id} brings its own reward and scene; leave it away")
    check_goal(config)
    reason = objection(changed, config)
    check(not reason, "variant", config.variant, f"{reason}; take another variant")


def _named(fields: Sequence[str], changed: RunConfig) -> list[str]:
    """The config's fields that the command line names, by their dotted names."""
    words = [word.removeprefix("--").split("=")[0].replace("-", "_") for word in fields if word.startswith("--")]
    words = [word.replace(".no_", ".", 1) if not _has(changed, word) else word for word in words]
    return [word for word in dict.fromkeys(words) if _has(changed, word)]


def _has(config: RunConfig, name: str) -> bool:
    try:
        _value(config, name)
    except AttributeError:
        return False
    return True


def _value(config: RunConfig, name: str) -> object:
    return reduce(getattr, name.split("."), config)
