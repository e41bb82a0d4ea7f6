"""Calls to actors: the only place that uses `.remote`. The typed clients beside this file are built on it.

Callers of those see plain values, never references; whatever Ray raises becomes one of our own errors here.
"""

from typing import Any

import ray
import ray.exceptions

from slotfilm_dist.cluster.actors import CONCURRENCY
from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError, RoleUnreachableError

ANSWER_S = 60.0
"""Longest wait for an answer that takes no time to give."""


class ActorLink:
    """One actor, by the name that errors use for it.

    Args:
        actor: Ray's handle.
        name: of the role.
    """

    def __init__(self, actor: Any, name: str) -> None:
        self._actor, self.name = actor, name

    @classmethod
    def launch(
        cls,
        role: type,
        name: str,
        *arguments: Any,
        keywords: dict[str, Any] | None = None,
        registered: str | None = None,
        **options: Any,
    ) -> "ActorLink":
        """Start an actor; does not wait for its process.

        Args:
            role: class of `actors.py`.
            name: for errors.
            arguments: of its constructor.
            keywords: of its constructor.
            registered: name under which other drivers find it.
            options: Ray's resources and restarts.
        """
        if registered is not None:
            options["name"] = registered
        remote_class = ray.remote(concurrency_groups=CONCURRENCY[role], **options)(role)  # pyright: ignore[reportCallIssue]
        return cls(remote_class.remote(*arguments, **(keywords or {})), name)

    @classmethod
    def find(cls, registered: str, namespace: str) -> "ActorLink":
        """A running actor; raises ``ValueError`` if there is none of that name."""
        try:
            return cls(ray.get_actor(registered, namespace=namespace), registered)
        except ValueError:
            raise ValueError(f"no live run is named {namespace!r} on this cluster; is it still running?") from None

    def begin(self, method: str, *arguments: Any, **keywords: Any) -> Any:
        """Call a method; `answer` takes the result. Does not wait."""
        return getattr(self._actor, method).remote(*arguments, **keywords)

    def answer(self, request: Any, waiting_for: str, timeout_s: float) -> Any:
        """The result of `begin`.

        Raises:
            RoleLostError: the process is gone; `RoleUnreachableError` while Ray does not know why.
            RoleSilentError: no answer in time.
            Exception: what the role itself raised.
        """
        try:
            return ray.get(request, timeout=timeout_s)
        except ray.exceptions.GetTimeoutError:
            raise RoleSilentError(self.name, waiting_for, timeout_s) from None
        except ray.exceptions.RayTaskError as error:
            cause = error.cause if isinstance(error.cause, Exception) else error
            raise cause from None
        except ray.exceptions.ActorUnavailableError as error:
            raise RoleUnreachableError(self.name, "crash", _one_line(str(error))) from None
        except ray.exceptions.RayError as error:
            if _could_not_begin(error):
                cause = _last_line(str(error))
                if cause.startswith("ValueError: "):
                    raise ValueError(cause.removeprefix("ValueError: ")) from None
                raise RoleLostError(self.name, "crash", cause) from None
            raise RoleLostError(self.name, _reason(error), _one_line(str(error))) from None

    def kill(self) -> None:
        """End the process at once and for good."""
        ray.kill(self._actor)


def is_ready(request: Any, timeout_s: float = 0.0) -> bool:
    """Whether the result of `ActorLink.begin` is there."""
    return bool(ray.wait([request], timeout=timeout_s)[0])


def _could_not_begin(error: ray.exceptions.RayError) -> bool:
    """The role's constructor raised; Ray hands its traceback on as text alone."""
    return isinstance(error, ray.exceptions.ActorDiedError) and "error raised in its creation task" in str(error)


def _last_line(text: str) -> str:
    return next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "no reason given")


def _reason(error: ray.exceptions.RayError) -> str:
    """The metric catalogue's word for why a process is gone; Ray's text lists causes that it only thinks possible."""
    text = str(error).lower()
    if isinstance(error, ray.exceptions.OutOfMemoryError) or "memory usage threshold" in text:
        return "memory"
    if getattr(error, "preempted", False):
        return "preempted"
    lost = ("node died", "node has died", "node was terminated")
    return "node_lost" if any(words in text for words in lost) else "crash"


def _one_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    named = [line for line in lines if line.lower().startswith(("the actor", "worker exit", "the worker"))]
    return (named or lines or ["no reason given"])[0]
