"""Functions of tensors as CUDA graphs: of small networks it is the launches that take time, not the arithmetic."""

import contextlib
from collections.abc import Callable, Mapping
from typing import Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Shaped
from torch import Tensor

WARM_UP_CALLS = 3
"""Calls that really run before the next one is recorded, as CUDA's libraries need to set themselves up."""
ALIGNMENT = 64
"""Bytes that each array's place in a `Feed` is a multiple of."""
BATCH_SIZES = (1, 2, 4, 8, 16, 32, 64, 128, 256)
"""Batch sizes of `SizedCaptures`."""

Result = TypeVar("Result")


class Feed:
    """Takes arrays of fixed shapes to fixed places on a device, all of them in one copy.

    Two pinned buffers take turns, so the next arrays are gathered while the last ones are still being copied.

    Args:
        like: arrays of the names, shapes and types to come.
        device: where they go.
    """

    def __init__(self, like: Mapping[str, np.ndarray], device: torch.device) -> None:
        places: dict[str, tuple[int, int]] = {}
        size = 0
        for name, array in like.items():
            places[name] = size, array.nbytes
            size += -(-array.nbytes // ALIGNMENT) * ALIGNMENT
        on_gpu = device.type == "cuda"
        self._there = torch.zeros(size, dtype=torch.uint8, device=device)
        self._here = [torch.zeros(size, dtype=torch.uint8, pin_memory=on_gpu) for _ in range(2)]
        self._copied = [torch.cuda.Event() if on_gpu else None for _ in range(2)]
        self._turn = 0
        types = {name: torch.from_numpy(np.empty(0, array.dtype)).dtype for name, array in like.items()}
        self.tensors: dict[str, Tensor] = {
            name: self._there[start : start + size].view(types[name]).view(like[name].shape)
            for name, (start, size) in places.items()
        }
        """What the arrays become; the same tensors for good, with the values of the last `fill`."""
        self._slots = [
            {
                name: here.numpy()[start : start + size].view(like[name].dtype).reshape(like[name].shape)
                for name, (start, size) in places.items()
            }
            for here in self._here
        ]

    def fill(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Start copying arrays; what is computed after this sees them. They may be smaller along the first axis."""
        self._turn ^= 1
        copied = self._copied[self._turn]
        if copied is not None:
            copied.synchronize()
        for name, slot in self._slots[self._turn].items():
            slot[: len(arrays[name])] = arrays[name]
        self._there.copy_(self._here[self._turn], non_blocking=True)
        if copied is not None:
            copied.record()


class Capture(Generic[Result]):
    """Calls a function on a GPU, from the fourth call on as a recorded CUDA graph; on a CPU it only calls it.

    Args:
        function: reads and writes tensors that stay where they are, waits for no result, and draws no random numbers.
            What it returns is the same tensors every time once it is recorded: use them before the next call.
        device: where it computes.
    """

    def __init__(self, function: Callable[[], Result], device: torch.device) -> None:
        self._function, self._device = function, device
        self._num_calls = 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self._recorded: list[Result] = []

    def __call__(self) -> Result:
        if self._device.type != "cuda":
            return self._function()
        if self._num_calls < WARM_UP_CALLS:
            self._num_calls += 1
            return self._call_aside()
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            # Other threads of this process may go on using the GPU meanwhile.
            with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
                self._recorded.append(self._function())
        self._graph.replay()
        return self._recorded[0]

    def _call_aside(self) -> Result:
        """On a stream of its own, as recording will."""
        current, aside = torch.cuda.current_stream(self._device), torch.cuda.Stream(self._device)
        aside.wait_stream(current)
        with torch.cuda.stream(aside):
            result = self._function()
        current.wait_stream(aside)
        return result


class Aside:
    """Work that a GPU does beside the rest: `with aside: ...`, and `aside.join()` before its results are used.

    On a CPU, one after the other.
    """

    def __init__(self, device: torch.device) -> None:
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        self._inside = contextlib.ExitStack()

    def __enter__(self) -> None:
        if self._stream is not None:
            self._stream.wait_stream(torch.cuda.current_stream(self._stream.device))
            self._inside.enter_context(torch.cuda.stream(self._stream))

    def __exit__(self, *error: object) -> None:
        self._inside.close()

    def join(self) -> None:
        """What follows waits for what was begun aside."""
        if self._stream is not None:
            torch.cuda.current_stream(self._stream.device).wait_stream(self._stream)


class SizedCaptures:
    """A function of batches as CUDA graphs, one for each of a few batch sizes; other batches are filled up to the next.

    Args:
        function: of tensors by name, each with one row per sample; gives such tensors. See `Capture`.
        device: where it computes.
    """

    def __init__(self, function: Callable[[Mapping[str, Tensor]], tuple[Tensor, ...]], device: torch.device) -> None:
        self._function, self._device = function, device
        self._by_shapes: dict[tuple[object, ...], tuple[Feed, Capture[tuple[Tensor, ...]]]] = {}

    def __call__(self, arrays: Mapping[str, np.ndarray]) -> tuple[Shaped[np.ndarray, "rows ..."], ...]:
        """What the function gives for these rows."""
        num_rows = len(next(iter(arrays.values())))
        size = next((size for size in BATCH_SIZES if size >= num_rows), num_rows)
        key = (size, *((name, array.shape[1:], array.dtype) for name, array in arrays.items()))
        if key not in self._by_shapes:
            feed = Feed({k: np.empty((size, *v.shape[1:]), v.dtype) for k, v in arrays.items()}, self._device)
            self._by_shapes[key] = feed, Capture(lambda: self._function(feed.tensors), self._device)
        feed, call = self._by_shapes[key]
        feed.fill(arrays)
        return tuple(result[:num_rows].cpu().numpy() for result in call())
