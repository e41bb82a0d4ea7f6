"""What can go wrong with a role, told in one line. Free of Ray, so that a command can catch it."""


class RoleLostError(Exception):
    """The process of a role is gone.

    Args:
        name: of the role.
        reason: a word of the metric catalogue's restart reasons.
        cause: one line.
    """

    def __init__(self, name: str, reason: str, cause: str) -> None:
        super().__init__(f"{name} is gone: {cause}")
        self.name, self.reason, self.cause = name, reason, cause

    def __reduce__(self) -> tuple[type, tuple[str, str, str]]:
        return type(self), (self.name, self.reason, self.cause)


class RoleUnreachableError(RoleLostError):
    """The process of a role takes no calls, and Ray does not know yet whether it, or its whole node, is gone."""


class RoleSilentError(Exception):
    """A role did not answer in time.

    Args:
        name: of the role.
        waiting_for: what was asked.
        timeout_s: how long was waited.
    """

    def __init__(self, name: str, waiting_for: str, timeout_s: float) -> None:
        super().__init__(f"{name} did not answer within {timeout_s:g} s: {waiting_for}")
        self.name, self.waiting_for, self.timeout_s = name, waiting_for, timeout_s

    def __reduce__(self) -> tuple[type, tuple[str, str, float]]:
        return type(self), (self.name, self.waiting_for, self.timeout_s)
