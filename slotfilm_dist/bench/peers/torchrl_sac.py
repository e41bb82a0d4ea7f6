"""TorchRL's `SACLoss` with a value network on our encoder's latent, in a process of its own.

The same modules in everything that costs time: our encoder on tokens, actor, two critics and value network of two
layers of 256, fused Adam, target value network moved by TorchRL's `SoftUpdate`. One forward, one backward over the sum
of the losses, one optimiser step: the least that TorchRL can do, and less than separate optimisers.
"""

# pyright: reportMissingImports=false
# Some of these packages are in the peers' environment only.

from collections.abc import Callable, Mapping

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SoftUpdate
from torchrl.objectives.sac import SACLoss

from slotfilm_dist.bench.agent import bench_config, learner_for
from slotfilm_dist.bench.serving import serve
from slotfilm_dist.bench.timing import calls_per_s
from slotfilm_dist.bench.transitions import ACTION_DIM, token_batch


def build() -> Mapping[str, Callable[..., float]]:
    """`measure`: updates a second on one batch of tokens."""
    torch.set_num_threads(1)
    config = bench_config()
    encoder = learner_for(config).encoder
    loss = _loss(encoder.latent_dim)
    trained = [*loss.parameters(), *encoder.fusion_parameters()]
    optimiser = torch.optim.Adam([p for p in trained if p.requires_grad], lr=3e-4, fused=True)
    target = SoftUpdate(loss, tau=config.sac.tau)
    raw = token_batch(np.random.default_rng(0), config.sac.batch_size, config)
    size = config.sac.batch_size

    def update() -> None:
        arrays = (raw.visual, raw.proprio, raw.goal, raw.next_visual, raw.next_proprio, raw.next_goal)
        tensors = [torch.from_numpy(array) for array in arrays]
        latent = encoder(*tensors[:3])
        with torch.no_grad():
            after = encoder(*tensors[3:])
        ended = torch.from_numpy(raw.terminated)[:, None]
        reward = torch.from_numpy(raw.reward)[:, None] * config.sac.reward_scale
        following = {"latent": after, "reward": reward, "done": ended, "terminated": ended}
        batch = TensorDict(
            {"latent": latent, "action": torch.from_numpy(raw.action), "next": TensorDict(following, [size])}, [size]
        )
        parts = loss(batch)
        total = parts["loss_actor"] + parts["loss_qvalue"] + parts["loss_value"]
        optimiser.zero_grad(set_to_none=True)
        total.backward()
        optimiser.step()
        target.step()

    return {"measure": lambda num_updates: calls_per_s(update, num_updates)}


def _loss(latent: int) -> SACLoss:
    layers = {"num_cells": [256, 256], "activation_class": nn.ReLU}
    body = nn.Sequential(MLP(in_features=latent, out_features=2 * ACTION_DIM, **layers), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(body, in_keys=["latent"], out_keys=["loc", "scale"]),
        spec=Bounded(-1.0, 1.0, (ACTION_DIM,)),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(in_features=latent + ACTION_DIM, out_features=1, **layers), in_keys=["latent", "action"])
    value = ValueOperator(MLP(in_features=latent, out_features=1, **layers), in_keys=["latent"])
    loss = SACLoss(actor, critic, value_network=value, num_qvalue_nets=2, fixed_alpha=True, loss_function="l2")
    loss.make_value_estimator(gamma=0.99)
    return loss


if __name__ == "__main__":
    serve(build)
