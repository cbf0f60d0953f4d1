"""What a user can put right: bad input and impossible requests, each said in one sentence."""


class InputError(ValueError):
    """Say which file or option is wrong, what is wrong with it, and what would be right.

    The command line prints the sentence and leaves with exit status 2; nothing has been written by then.
    """


class MethodError(RuntimeError):
    """Say in one sentence why a method cannot answer for this series (too few matches, no texture, ...)."""
