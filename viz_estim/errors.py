"""The one exception that the command line turns into one line and exit code 2."""


class BadInput(ValueError):
    """What a person gave cannot be used: says what is wrong, where, and what to do."""
