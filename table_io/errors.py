"""Errors that a user can correct."""


class InputError(ValueError):
    """A file, value or option that a user must correct; commands end with exit code 2.

    The message is composed of the given fields in this order: `where: key = value: problem;
    allowed: ...; remedy`. Tests and programs read the fields, users read the message.
    """

    def __init__(
        self,
        problem: str,
        *,
        where: object = "",
        key: str = "",
        value: object = None,
        allowed: str = "",
        remedy: str = "",
    ) -> None:
        self.problem = problem
        self.where = str(where)
        self.key = key
        self.value = value
        self.allowed = allowed
        self.remedy = remedy
        subject = key if value is None else f"{key} = {value!r}" if key else repr(value)
        message = ": ".join(part for part in (self.where, subject, problem) if part)
        if allowed:
            message += f"; allowed: {allowed}"
        if remedy:
            message += f"; {remedy}"
        super().__init__(message)
