"""Agents of the study: each a visible difference from the proposed one."""

import difflib
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Literal

from slotfilm_dist.config import PROPRIO_FIELDS, DdpgConfig, LrConfig, RunConfig
from slotfilm_dist.config_files import changed_fields

Variant = Callable[[RunConfig], RunConfig]

DRQ_FEATURES = 50
"""What both DrQ algorithms project their convolutions to."""


def slotfilm(base: RunConfig) -> RunConfig:
    """The proposed agent: slots, FiLM with tanh, no goal query (Section 4)."""
    return base


def slotfilm_goal(base: RunConfig) -> RunConfig:
    """The proposed agent with the goal query and its gate (Section 4.1.3)."""
    return replace(base, encoder=replace(base.encoder, goal=True))


def no_state(base: RunConfig) -> RunConfig:
    """Slots alone, without the robot's state (Section 6.2)."""
    return replace(base, encoder=replace(base.encoder, fusion="none"))


def film_clamp(base: RunConfig) -> RunConfig:
    """Linear scale clamped to [-1, 1] instead of tanh (Section 7.1)."""
    return replace(base, encoder=replace(base.encoder, fusion="film_clamp"))


def concat_proj(base: RunConfig) -> RunConfig:
    """Slots and state concatenated and projected back, instead of FiLM (Section 7.1)."""
    return replace(base, encoder=replace(base.encoder, fusion="concat_proj"))


def concat_late(base: RunConfig) -> RunConfig:
    """State appended to the pooled slots at the policy's input, instead of FiLM (Section 7.1)."""
    return replace(base, encoder=replace(base.encoder, fusion="concat_late"))


def state_only(base: RunConfig) -> RunConfig:
    """The robot's state alone, without a camera (Section 5.1)."""
    return replace(base, encoder=replace(base.encoder, fusion="state_only", goal=False))


def cnn(base: RunConfig) -> RunConfig:
    """A plain convolutional network that learns from the critics, without the state (Section 5.1)."""
    pixels = _on_pixels(base, "cnn", base.encoder.feature_dim)
    return replace(pixels, lr=_with_the_critics(base))


def drq(base: RunConfig) -> RunConfig:
    """DrQ-v1's encoder and its averages over two random shifts on the same SAC, without the state (Section 5.1)."""
    pixels = _on_pixels(base, "drq", DRQ_FEATURES)
    return replace(pixels, lr=_with_the_critics(base), sac=replace(base.sac, augment_views=2))


def drqv2(base: RunConfig) -> RunConfig:
    """DrQ-v2 with its own deterministic algorithm, without the state, for 2000 epochs (Appendix A.5)."""
    pixels, schedule = _on_pixels(base, "drqv2", DRQ_FEATURES), base.schedule
    learning_steps = schedule.total_steps - schedule.random_steps
    total_steps = max(schedule.total_steps * 2 // 3, schedule.random_steps + max(1, learning_steps * 7 // 11))
    # 800k of 1.2 M steps are 2/3 of all and 7/11 of the learning. The noise falls until step 500k, 4/7 of that.
    std_steps = schedule.random_steps + (total_steps - schedule.random_steps) * 4 // 7
    chosen = base.ddpg.std_steps != DdpgConfig().std_steps
    return replace(
        pixels,
        ddpg=base.ddpg if chosen else replace(base.ddpg, std_steps=std_steps),
        sac=replace(base.sac, batch_size=2 * base.sac.batch_size),
        schedule=replace(schedule, total_steps=total_steps, updates_per_step=schedule.updates_per_step / 2),
    )


def cnn_state(base: RunConfig) -> RunConfig:
    """`cnn` with the state appended to its latent (beyond the paper)."""
    return _with_state(cnn(base))


def drq_state(base: RunConfig) -> RunConfig:
    """`drq` with the state appended to its latent (beyond the paper)."""
    return _with_state(drq(base))


def drqv2_state(base: RunConfig) -> RunConfig:
    """`drqv2` with the state appended to what its trunks make of the picture (beyond the paper)."""
    return _with_state(drqv2(base))


def _on_pixels(base: RunConfig, kind: Literal["cnn", "drq", "drqv2"], feature_dim: int) -> RunConfig:
    """No pre-training and no slots: the encoder learns from pictures and reward alone."""
    encoder = replace(base.encoder, kind=kind, feature_dim=feature_dim, backbone="random", fusion="none", goal=False)
    return replace(
        base,
        algorithm="ddpg" if kind == "drqv2" else "sac",
        encoder=encoder,
        pretrain=replace(base.pretrain, steps=0),
    )


def _with_the_critics(base: RunConfig) -> LrConfig:
    """The encoder's rate is that of the critics, whose part it is while it learns from nothing."""
    return replace(base.lr, fusion=base.lr.critic_value)


def _with_state(pixels: RunConfig) -> RunConfig:
    return replace(pixels, encoder=replace(pixels.encoder, fusion="concat_late"))


def varpi_1(base: RunConfig) -> RunConfig:
    """Sharpness 1 of the stability term, where the paper has 5 (Figure 11)."""
    return replace(base, reward=replace(base.reward, varpi=1.0))


def varpi_10(base: RunConfig) -> RunConfig:
    """Sharpness 10 of the stability term, where the paper has 5 (Figure 11)."""
    return replace(base, reward=replace(base.reward, varpi=10.0))


def no_static(base: RunConfig) -> RunConfig:
    """No stability term (Figure 12); the others count what they did, so that nothing else changes."""
    weights, divisor = base.reward.weights, base.reward.divisor
    kept = {f.name: getattr(weights, f.name) / divisor for f in fields(weights)} | {"static": 0.0}
    return replace(base, reward=replace(base.reward, normalize="none", weights=replace(weights, **kept)))


def alpha_5(base: RunConfig) -> RunConfig:
    """A slower decay of the distance terms (Figure 13, as the text reads)."""
    return replace(base, reward=replace(base.reward, alpha=5.0))


def alpha_15(base: RunConfig) -> RunConfig:
    """A faster decay of the distance terms (Figure 13, as the text reads)."""
    return replace(base, reward=replace(base.reward, alpha=15.0))


def reward_scale_5(base: RunConfig) -> RunConfig:
    """Half the reward scale (Figure 13, as its label reads)."""
    return replace(base, sac=replace(base.sac, reward_scale=base.sac.reward_scale * 0.5))


def reward_scale_15(base: RunConfig) -> RunConfig:
    """One and a half times the reward scale (Figure 13, as its label reads)."""
    return replace(base, sac=replace(base.sac, reward_scale=base.sac.reward_scale * 1.5))


def slots_4(base: RunConfig) -> RunConfig:
    """Twice as many slots as objects (Section 7.3)."""
    return replace(base, encoder=replace(base.encoder, num_slots=4))


def slots_competitive(base: RunConfig) -> RunConfig:
    """Slots compete for tokens: softmax over slots (beyond the paper)."""
    return replace(base, encoder=replace(base.encoder, slot_normalize="slots"))


def end_to_end(base: RunConfig) -> RunConfig:
    """No pre-training; the whole encoder learns from the critics, from random weights (Section 7.4)."""
    return replace(
        base,
        encoder=replace(base.encoder, backbone="random"),
        pretrain=replace(base.pretrain, steps=0),
        sac=replace(base.sac, end_to_end=True),
    )


def oracle_state(base: RunConfig) -> RunConfig:
    """State and the objects' true poses, without a camera: validates task and learner, no part of the study."""
    fields = (*PROPRIO_FIELDS, "object_poses", "tcp_to_object", "object_to_goal")
    obs = base.obs
    state_dim = 35 + 7 * obs.num_objects + 6
    return state_only(replace(base, obs=replace(obs, state_fields=fields, state_dim=state_dim)))


SECTIONS: dict[str, tuple[Variant, ...]] = {
    "proposed": (slotfilm, slotfilm_goal),
    "fusion": (no_state, film_clamp, concat_proj, concat_late),
    "baseline": (state_only, cnn, drq, drqv2, cnn_state, drq_state, drqv2_state),
    "reward": (varpi_1, varpi_10, no_static, alpha_5, alpha_15, reward_scale_5, reward_scale_15),
    "slots": (slots_4, slots_competitive),
    "training": (end_to_end,),
    "validation": (oracle_state,),
}
"""Variants by what they vary."""

VARIANTS: dict[str, Variant] = {variant.__name__: variant for group in SECTIONS.values() for variant in group}


def apply_variant(name: str, base: RunConfig) -> RunConfig:
    """The base config turned into a variant; raises ``ValueError`` with the nearest known name."""
    if name not in VARIANTS:
        near = difflib.get_close_matches(name, VARIANTS, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(VARIANTS)}"
        raise ValueError(f"variant = {name!r}: no such variant; {hint}")
    return replace(VARIANTS[name](base), variant=name)


def describe_variant(name: str) -> dict[str, object]:
    """Name, section, difference in words and the fields that differ from the proposed agent."""
    base = RunConfig()
    section = next(s for s, group in SECTIONS.items() if VARIANTS[name] in group)
    changed = changed_fields(base, VARIANTS[name](base))
    return {
        "name": name,
        "section": section,
        "difference": (VARIANTS[name].__doc__ or "").strip(),
        "params": {field: new for field, (_, new) in changed.items()},
    }
