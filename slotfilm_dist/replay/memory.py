"""Whether a run's replay will fit into memory, asked before anything is collected."""

from slotfilm_dist.config import RunConfig
from slotfilm_dist.replay.ring import ring_rows
from slotfilm_dist.replay.schema import ReplaySchema

SHARE = 0.8
"""Share of the memory that replay may take; simulator, networks and libraries need the rest."""
_ACTION_DIM = 8
"""Close enough: an action is nothing beside a picture."""
_GB = 1e9


def check_memory(config: RunConfig, usable_bytes: int) -> None:
    """Refuse a run whose replay would not fit once it is full.

    Args:
        config: the run; steps beyond `schedule.total_steps` are never stored.
        usable_bytes: memory of the machine, or of the whole cluster.

    Raises:
        ValueError: names the capacity that fits.
    """
    steps = min(config.replay.capacity, config.schedule.total_steps)
    needed = replay_bytes(config, steps)
    if needed <= SHARE * usable_bytes:
        return
    fits = int(steps * SHARE * usable_bytes / needed)
    # Two digits are enough, and rounding down keeps it fitting.
    fits -= fits % 10 ** max(0, len(str(fits)) - 2)
    kind = "pictures" if config.stores_pictures else "transitions"
    raise ValueError(
        f"replay.capacity = {config.replay.capacity}: {steps} {kind} take {needed / _GB:.1f} GB, and "
        f"{SHARE:.0%} of the {usable_bytes / _GB:.1f} GB that may be used are for replay; "
        f"set --replay.capacity to {fits} or less"
    )


def replay_bytes(config: RunConfig, steps: int) -> int:
    """Memory of so many stored steps."""
    size = config.env.image_size
    if config.stores_pictures:
        kind, shape = "rgb", (size, size, 3)
    elif config.encoder.uses_image:
        kind, shape = "tokens", ((size // 16) ** 2, config.encoder.feature_dim)
    else:
        kind, shape = "none", (0,)
    schema = ReplaySchema(
        visual_kind=kind,
        visual_shape=shape,
        proprio_dim=config.obs.state_dim,
        action_dim=_ACTION_DIM,
        num_objects=config.obs.num_objects,
        backbone_hash="any" if kind == "tokens" else "",
    )
    return ring_rows(steps, config.runtime.block_steps) * schema.row_bytes
