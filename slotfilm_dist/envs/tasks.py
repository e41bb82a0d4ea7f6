"""What the system needs to know of a task. A new ManiSkill task with a Panda's wrist camera is one entry here."""

import dataclasses
import difflib
from dataclasses import dataclass

from slotfilm_dist.config import RunConfig, check
from slotfilm_dist.config_files import changed_fields


@dataclass(frozen=True, kw_only=True, slots=True)
class Task:
    """A ManiSkill task seen through the wrist camera of a Panda."""

    env_id: str
    """ManiSkill's name of the environment."""
    objects: tuple[str, ...]
    """Attributes that hold the tracked actors, which supervise the slots; the first is to be grasped."""
    goal: str
    """Attribute that holds the goal's actor; empty for none (its state fields then read zero)."""
    max_steps: int
    """Length of an episode in control steps."""
    placed: str
    """Key of the task's info that says that the object is at its target."""
    robot: str = "panda_wristcam"
    """ManiSkill's name of the robot."""
    own_reward: bool = False
    """Takes the `reward` and `success` sections; other tasks bring ManiSkill's normalised dense reward and success."""


TASKS: dict[str, Task] = {
    "PickBanana-v1": Task(
        env_id="PickBanana-v1",
        objects=("banana", "bowl"),
        goal="goal_site",
        max_steps=400,
        placed="is_placed",
        robot="panda_wristcam_direct",
        own_reward=True,
    ),
    "PickCube-v1": Task(
        env_id="PickCube-v1", objects=("cube",), goal="goal_site", max_steps=100, placed="is_obj_placed"
    ),
    "StackCube-v1": Task(
        env_id="StackCube-v1", objects=("cubeA", "cubeB"), goal="", max_steps=100, placed="is_cubeA_on_cubeB"
    ),
}


def task_named(name: str) -> Task:
    """The description of a task; raises ``ValueError`` with the nearest known name."""
    if name not in TASKS:
        near = difflib.get_close_matches(name, TASKS, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(TASKS)}"
        raise ValueError(f"env.task = {name!r}: no such task is described in envs/tasks.py; {hint}")
    return TASKS[name]


def adapt_config(config: RunConfig) -> RunConfig:
    """The config with what follows from its task: number of objects, slots, episode length.

    Values that differ from PickBanana's defaults are the user's and stay.
    """
    task = task_named(config.env.task)
    num_objects = len(task.objects)
    defaults = RunConfig()
    env, obs, encoder = config.env, config.obs, config.encoder
    if env.max_steps == defaults.env.max_steps:
        env = dataclasses.replace(env, max_steps=task.max_steps)
    if obs.num_objects != num_objects:
        extra = sum(name == "object_poses" for name in obs.state_fields) * 7 * (num_objects - obs.num_objects)
        obs = dataclasses.replace(obs, num_objects=num_objects, state_dim=obs.state_dim + extra)
    if encoder.num_slots == defaults.encoder.num_slots:
        encoder = dataclasses.replace(encoder, num_slots=max(num_objects, 1))
    return dataclasses.replace(config, env=env, obs=obs, encoder=encoder)


def objection(base: RunConfig, config: RunConfig) -> str:
    """Why a variant has no meaning on its task: it asks for what is not there, or is the base again; else empty.

    Args:
        base: the proposed agent.
        config: the variant of it.
    """
    task = task_named(config.env.task)
    changed = changed_fields(base, config).keys() - {"variant"}
    if not task.goal and "encoder.goal" in changed and config.encoder.goal:
        return f"{task.env_id} has no goal point to query"
    if not task.own_reward and changed and all(field.startswith("reward.") for field in changed):
        return f"{task.env_id} brings its own reward"
    return ""


def check_goal(config: RunConfig) -> None:
    """Raise ``ValueError`` if the encoder queries a goal that the task does not have."""
    task = task_named(config.env.task)
    want = f"{task.env_id} has no goal point to query; leave --encoder.goal and the variant slotfilm_goal away"
    check(not config.encoder.goal or bool(task.goal), "encoder.goal", config.encoder.goal, want)
