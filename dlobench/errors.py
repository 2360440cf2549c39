"""Names the two ways in which a command can end badly, each with the exit code it ends with."""


class UsageError(Exception):
    """Says what was asked wrongly, with the offending value and the choices that exist (exit code 2)."""

    exit_code = 2


class RunError(Exception):
    """Says what failed although it was asked rightly: a full disk, a broken shard, a diverged fit (exit code 1)."""

    exit_code = 1
