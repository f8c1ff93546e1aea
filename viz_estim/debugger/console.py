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
from viz_estim.errors import BadInput

# The order is the help's; of several commands that a beginning fits, the first is meant.
COMMANDS = (
    "step", "back", "stage", "goto", "continue", "reverse", "break", "breaks", "delete", "print", "display", "names",
    "where", "why", "set", "branches", "switch", "compare", "save", "quit", "help",
)  # fmt: skip


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
            self.say(f"error: {_one_line(error)}")
        except KeyboardInterrupt:
            self.say("interrupted")
        except Exception as error:  # whatever it is, it must not cost the session
            self.say(f"error: {type(error).__name__}: {_one_line(error)}")
        return False

    def completenames(self, text: str, *ignored: object) -> list[str]:
        return [name for name in COMMANDS if name.startswith(text)]

    def _written_out(self, line: str) -> str:
        """The line with its command's whole name."""
        line = line.strip()
        if not line:
            return line
        head, *rest = line.split(None, 1)
        name = "help" if head == "?" else next((n for n in COMMANDS if n == head), None)
        name = name or next((n for n in COMMANDS if n.startswith(head)), None)
        if name is None:
            close = get_close_matches(head, COMMANDS, n=1, cutoff=0.5)
            raise Refused(f"no command {head}; {f'did you mean {close[0]}?' if close else '`help` lists them'}")
        return " ".join([name, *rest])


def count(text: str) -> int:
    """How often: 1 unless it is said."""
    if not re.fullmatch(r"[0-9]{0,9}", text):
        raise Refused(f"{text}: expected a whole number from 0 on")
    return int(text) if text else 1


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
