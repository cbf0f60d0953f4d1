"""What a user can put right, said in one sentence."""


class InputError(ValueError):
    """Say which file or option is wrong, what is wrong with it, and what would be right.

    The command line prints the sentence and leaves with exit status 2; nothing has been written by then.
    """
