"""The console script, and `python -m viz_estim`, which is the same."""

import os
import signal


def entry() -> None:
    """Runs the command line. All else is read in here, which takes a third of a second: a Ctrl-C in that time ends the
    program as it does later. At once, for an exception that comes while numpy is read is taken for its failure."""
    usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # else it is ignored, as of a job behind
    if usual:
        signal.signal(signal.SIGINT, _leave)
    from viz_estim.cli import entry as run

    if usual:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    run()


def _leave(*_: object) -> None:
    os.write(2, b"viz-estim: interrupted\n")
    os._exit(130)


if __name__ == "__main__":
    entry()
