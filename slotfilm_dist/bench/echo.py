"""A contender that only answers, to try out the way to a child process and back."""

import os

from slotfilm_dist.bench.serving import serve


def build(*, factor: float) -> dict:
    """`times` multiplies, `threads` gives what the process was told, `fail` fails."""
    if factor < 0:
        raise ValueError("factor: must not be negative")

    def fail() -> None:
        print("noise of a library")
        raise RuntimeError("no luck")

    return {"times": lambda number: number * factor, "threads": lambda: os.environ["OMP_NUM_THREADS"], "fail": fail}


if __name__ == "__main__":
    serve(build)
