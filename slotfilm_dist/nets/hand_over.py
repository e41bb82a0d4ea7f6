"""What every encoder does alike: standardise the state, and hand the weights that acting needs to the workers."""

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

_SMALLEST_STD = 1e-6


class HandedOver(nn.Module):
    """An encoder whose learner makes `acting_state` and whose workers load it.

    Args:
        state_dim: size of the state.
    """

    proprio_mean: Tensor
    proprio_std: Tensor

    def __init__(self, state_dim: int) -> None:
        super().__init__()
        self.register_buffer("proprio_mean", torch.zeros(state_dim))
        self.register_buffer("proprio_std", torch.ones(state_dim))

    @torch.no_grad()
    def set_state_statistics(self, mean: Float[Tensor, " proprio"], std: Float[Tensor, " proprio"]) -> None:
        """Standardise the state from now on; a dimension that never varied is only centred."""
        assert mean.shape == std.shape == self.proprio_mean.shape
        self.proprio_mean.copy_(mean)
        self.proprio_std.copy_(torch.where(std > _SMALLEST_STD, std, 1.0))

    def standardise(self, proprio: Float[Tensor, "batch proprio"]) -> Float[Tensor, "batch proprio"]:
        """The state in deviations from its mean; as it is until `set_state_statistics`."""
        return (proprio - self.proprio_mean) / self.proprio_std

    def acting_state(self) -> dict[str, np.ndarray]:
        """Copies of what RL changes and acting needs."""
        return {name: value.cpu().numpy().copy() for name, value in self._acting_tensors().items()}

    @torch.no_grad()
    def load_acting_state(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over an `acting_state`.

        Raises:
            ValueError: it belongs to another encoder.
        """
        own = self._acting_tensors()
        if odd := sorted(own.keys() ^ arrays.keys()):
            raise ValueError(f"weights of another encoder: {odd[0]!r} is in only one of them; compare the two configs")
        for name, value in own.items():
            if value.shape != arrays[name].shape:
                raise ValueError(
                    f"weights of another encoder: {name} is {arrays[name].shape}, here {tuple(value.shape)}"
                )
            value.copy_(torch.from_numpy(np.array(arrays[name])))

    def _acting_tensors(self) -> dict[str, Tensor]:
        """Every weight and buffer; an encoder that freezes some of them leaves those out."""
        return dict(self.state_dict())
