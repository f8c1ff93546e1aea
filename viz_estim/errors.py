"""The one exception that the command line turns into one line and exit code 2, and one line of any."""


class BadInput(ValueError):
    """What a person gave cannot be used: says what is wrong, where, and what to do."""


def one_line(said: object) -> str:
    """What is said, an exception's or a person's own, on one line, whatever it was broken into."""
    return " ".join(str(said).split())
