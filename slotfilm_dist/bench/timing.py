"""How long a call takes."""

import time
from collections.abc import Callable


def calls_per_s(call: Callable[[], object], num_calls: int) -> float:
    """Calls a second, by the wall clock, over so many calls."""
    began = time.perf_counter()
    for _ in range(num_calls):
        call()
    return num_calls / (time.perf_counter() - began)
