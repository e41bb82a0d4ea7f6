"""The child's side of a contender in a process of its own: answers questions, one JSON line each."""

import json
import os
import sys
import traceback
from collections.abc import Callable, Mapping
from typing import Any


def serve(build: Callable[..., Mapping[str, Callable[..., Any]]]) -> None:
    """Build, say so, then answer until standard input ends.

    The arguments of `build` are the JSON object given as the program's only argument. What libraries print goes to
    standard error, so that nothing but answers is on standard output.

    Args:
        build: gives the methods that can be asked for, by name; each takes and gives plain values.
    """
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    try:
        methods = build(**json.loads(sys.argv[1]))
    except Exception as error:  # told to the parent, which reports it as the reason for a missing number
        traceback.print_exc()
        _answer(answers, {"error": f"{type(error).__name__}: {error}"})
        return
    _answer(answers, {"value": "ready"})
    for line in sys.stdin:
        question = json.loads(line)
        try:
            _answer(answers, {"value": methods[question["method"]](**question["arguments"])})
        except Exception as error:  # as above
            traceback.print_exc()
            _answer(answers, {"error": f"{type(error).__name__}: {error}"})


def _answer(answers: Any, value: dict[str, Any]) -> None:
    answers.write(json.dumps(value) + "\n")
