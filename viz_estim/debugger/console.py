"""The loop of a session: a line in, its command done, whatever goes wrong told in one line."""

from __future__ import annotations

import cmd
import re
from difflib import get_close_matches
from typing import IO

from viz_estim.debugger.branches import Branch
from viz_estim.debugger.functions import BadExpression
from viz_estim.debugger.quantities import Frame
from viz_estim.debugger.screen import Screen
from viz_estim.debugger.sources import NoSuchPlace
from viz_estim.errors import BadInput, one_line

# In the help's order.
COMMANDS = (
    "step", "back", "stage", "goto", "continue", "reverse", "break", "breaks", "delete", "print", "display", "names",
    "where", "why", "set", "branches", "switch", "compare", "save", "quit", "help",
)  # fmt: skip

# What a beginning means that fits several; any other such beginning is asked back.
SHORT = {"s": "step", "c": "continue", "r": "reverse", "p": "print", "d": "display", "w": "where", "n": "names"}


class Refused(ValueError):
    """A command that cannot be done: one line that says why."""


class Console(cmd.Cmd):
    """Reads commands from `stdin` and tells on `stdout`; a terminal has a prompt, a history, and completion by TAB.

    A place in the current branch is where it stands.
    """

    def __init__(self, branch: Branch, screen: Screen, stdin: IO[str], stdout: IO[str]) -> None:
        super().__init__("tab", stdin, stdout)
        self.use_rawinput = stdin.isatty()
        self.prompt = "(viz-estim) " if self.use_rawinput else ""
        self.branches, self.branch, self.screen = [branch], branch, screen
        self.place = branch.source.span(0).start

    @property
    def frame(self) -> Frame:
        """The stage at which it stands."""
        return self.branch.source.frame(self.place)

    @property
    def step(self) -> int:
        """The step in which it stands."""
        return int(self.frame.step[0])

    def say(self, text: str) -> None:
        """Tells the person."""
        print(text, file=self.stdout, flush=True)

    def loop(self) -> None:
        """Commands until the last."""
        while True:
            try:
                self.cmdloop()
                return
            except KeyboardInterrupt:
                self.say("interrupted")

    def onecmd(self, line: str) -> bool:
        """One command; True where it is the last."""
        try:
            if line == "EOF":
                return True
            return bool(super().onecmd(self._written_out(line)))
        except (Refused, BadExpression, NoSuchPlace, BadInput) as error:
            self.say(f"error: {one_line(error)}")
        except KeyboardInterrupt:
            self.say("interrupted")
        except (Exception, SystemExit) as error:  # whatever it is, of a person's filter too: it costs no session
            self.say(f"error: {type(error).__name__}: {one_line(error)}")
        return False

    def completenames(self, text: str, *ignored: object) -> list[str]:
        return [name for name in COMMANDS if name.startswith(text)]

    def _written_out(self, line: str) -> str:
        """The line with its command's whole name."""
        line = line.strip()
        if not line:
            return line
        head, *rest = line.split(None, 1)
        name = "help" if head == "?" else self._meant(head)
        usage = (getattr(self, f"do_{name}").__doc__ or "").partition("|")[0]
        if rest and usage == name:
            raise Refused(f"{name} takes nothing after it")
        return " ".join([name, *rest])

    def _meant(self, head: str) -> str:
        """The command of that name, or with that beginning."""
        fitting = [name for name in COMMANDS if name.startswith(head)]
        if head in fitting:
            return head
        if head in SHORT:
            return SHORT[head]
        if not fitting:
            close = get_close_matches(head, COMMANDS, n=1, cutoff=0.5)
            raise Refused(f"no command {head}; {f'did you mean {close[0]}?' if close else '`help` lists them'}")
        shortest = min(fitting, key=len)
        if not all(name.startswith(shortest) for name in fitting):  # as `bre` is break, not breaks
            raise Refused(f"{head}: {', '.join(fitting[:-1])} or {fitting[-1]}?")
        return shortest


def count(text: str) -> int:
    """How often: 1 unless it is said."""
    if not re.fullmatch(r"[0-9]{0,9}", text):
        raise Refused(f"{text}: expected a whole number from 0 on")
    return int(text) if text else 1
