"""A session: commands that look inside, that change the run and go on in a branch, and its beginning and end."""

from __future__ import annotations

import contextlib
import shlex
import shutil
from pathlib import Path
from typing import IO, Any

import numpy as np

from viz_estim.debugger import branches, forking
from viz_estim.debugger.branches import Branch
from viz_estim.debugger.console import COMMANDS, Refused, count
from viz_estim.debugger.differences import side_by_side
from viz_estim.debugger.frame_text import health_text, names_text, place_text, quantity_text, why_text
from viz_estim.debugger.functions import FUNCTIONS
from viz_estim.debugger.live import Live
from viz_estim.debugger.moving import Moving
from viz_estim.debugger.recorded import Recorded
from viz_estim.debugger.screen import Screen
from viz_estim.debugger.sources import NoSuchPlace
from viz_estim.errors import BadInput
from viz_estim.files import check_writable, whole
from viz_estim.parameters import kind_text, parameters
from viz_estim.recording.recorder import Recorder, partial_of
from viz_estim.running import plan, recorded


class Session(Moving):
    """All commands; `run` is a session from beginning to end."""

    def run(self) -> None:
        """Opens where the run stands, or where a recorded one failed; commands; then the branches' files are ended."""
        failure = self.branch.source.failure
        if failure:
            self.place = self.branch.source.span(failure.step)[-1]
        self.stop()
        if failure:
            self._post_mortem()
        try:
            self.loop()
        finally:
            for branch in self.branches:
                if branch.file:
                    branch.file.close()
                    self.say(f"branch {branch.number}: {branch.file.path}")
            self.screen.leave()

    def _post_mortem(self) -> None:
        """The last good belief, and the inputs of the step."""
        source = self.branch.source
        frame = self.frame
        for name in frame.inputs:
            self.say(f"  {quantity_text(name, frame.quantity(name))}")
        for place in range(self.place, -1, -1):
            good = source.frame(place)
            known = [name for name in ("mean", "probability") if name in good.names()]
            if known and all(np.isfinite(good.lookup(name)).all() for name in known):
                self.say(f"the last good belief, {place_text(good)}:")
                for name in [*known, *(["std"] if known == ["mean"] else [])]:
                    self.say(f"  {quantity_text(name, good.quantity(name))}")
                return

    # Looking.

    def do_print(self, text: str) -> None:
        """print EXPR|any quantity of the stage: mean.attitude, cov[0:3, 0:3], innovation.gyro, norm(error)"""
        if not text:
            raise Refused("print what? `names` lists what there is")
        self.say(self.worked_out(text))

    def do_names(self, text: str) -> None:
        """names|every quantity of this stage; functions are listed by `help print`"""
        self.say(names_text(self.frame))

    def do_where(self, text: str) -> None:
        """where|step, stage, time, and one line of health"""
        self.say(place_text(self.frame) + self.failed())
        branch = f"branch {self.branch.number};  " if len(self.branches) > 1 else ""
        self.say(f"  {branch}{health_text(self.frame)}")

    def do_why(self, text: str) -> None:
        """why|what moved the estimate in this update: K·ν by component of the reading, largest first"""
        self.say(why_text(self.frame))

    # Branches.

    def do_set(self, text: str) -> None:
        """set K=V|from this step on with another estimator parameter: the run forks, the old branch is kept"""
        try:
            settings = shlex.split(text)
        except ValueError as error:
            raise Refused(f"set {text}: {error}") from None
        parts, again = self._revived()
        if not settings:
            own = parameters(parts[-1].plan.source.scenario)
            lines = [f"  {k}={parts[-1].plan.params[k]}  ({kind_text(p)})" for k, p in own.items()]
            self.say("\n".join(lines) or "it has no parameters")
            return
        step, index = self.step, int(self.frame.index[0])
        parts = forking.changed(parts, step, settings, again)
        source = again.fork(step, parts[-1].scenario)
        if again.findings:
            source.findings = again.findings.until(step, parts[-1].scenario, parts[-1].plan.all_params())
        number = len(self.branches) + 1
        about = f"{' '.join(settings)} from step {step} on"
        self.branch = branches.of_parts(number, about, parts, source, self.screen, self.branch.number)
        self.branches.append(self.branch)
        span = source.span(step)
        self.say(f"branch {number}: {about}; this step is done again")
        self.go(span[min(index, len(span) - 1)])

    def _revived(self) -> tuple[list[forking.Part], Live]:
        """How the branch is run, and the run itself; a recording's is found again, up to this step."""
        source = self.branch.source
        if isinstance(source, Live):
            assert self.branch.parts
            return self.branch.parts, source
        assert isinstance(source, Recorded)
        parts = self.branch.parts or forking.revive(source.run)
        again = forking.live(parts)
        forking.check_same(source.run, again, self.step)
        self.branch.parts = parts
        return parts, again

    def do_branches(self, text: str) -> None:
        """branches|lists them"""
        for one in self.branches:
            here = "*" if one is self.branch else " "
            of = f" (of branch {one.parent})" if one.parent else ""
            self.say(f"{here} {one.number}: {one.about}{of}; to step {one.source.reached}")

    def do_switch(self, text: str) -> None:
        """switch N|to the same step of branch N"""
        self.branch, step = self._named(text), self.step
        source = self.branch.source
        if isinstance(source, Recorded):
            step = min(step, source.reached)
        self._to_step(step)

    def do_compare(self, text: str) -> None:
        """compare [N]|this branch beside its parent, or branch N, from the fork on; the one behind runs as far"""
        other = self._named(text or str(self.branch.parent or 2 - (self.branch.number == 2)))
        if other is self.branch:
            raise Refused(f"branch {other.number} with itself? `branches` lists what there is")
        furthest = max(other.source.reached, self.branch.source.reached)
        for one in (other, self.branch):
            with contextlib.suppress(NoSuchPlace):  # it ended before
                one.source.span(furthest)
        self.say(side_by_side(other, self.branch))

    def _named(self, text: str) -> Branch:
        if not text.isdecimal() or not 1 <= count(text) <= len(self.branches):
            raise Refused(f"no branch {text or 'without a number'}; `branches` lists them")
        return self.branches[int(text) - 1]

    def do_save(self, text: str) -> None:
        """save FILE|this branch so far as a recording"""
        if not text:
            raise Refused("save where? Give a file that ends in .rrd")
        path = Path(text[1:-1] if text[0] in "'\"" and text[-1] == text[0] else text)
        check_writable(path, suffix=".rrd")
        for branch in self.branches:
            if branch.file and path.resolve() in (branch.file.path.resolve(), partial_of(branch.file.path).resolve()):
                raise Refused(f"{path} is where branch {branch.number} is being recorded; choose another name")
            of = branch.source
            if isinstance(of, Recorded) and path.exists() and path.samefile(of.run.path):
                raise Refused(f"{path} is the recording that is looked into; choose another name")
        source = self.branch.source
        if isinstance(source, Recorded):
            with whole(path) as aside:
                shutil.copyfile(source.run.path, aside)
        elif isinstance(source, Live):
            assert self.branch.parts
            scenario = self.branch.parts[-1].scenario
            with Recorder(path, scenario, forking.properties(self.branch.parts)) as recorder:
                recorded(source.steps(), scenario, recorder, lambda done, total: None)
        self.say(f"viz-estim debug {shlex.quote(str(path))}")

    # The end, and help.

    def do_quit(self, text: str) -> bool:
        """quit|ends the session"""
        return True

    def do_help(self, arg: str) -> None:
        """help [COMMAND]|this"""
        wanted = [name for name in COMMANDS if name.startswith(arg)]
        if not wanted:
            raise Refused(f"no command {arg}")
        for name in wanted:
            usage, _, about = (getattr(self, f"do_{name}").__doc__ or "").partition("|")
            self.say(f"  {usage:24} {about}")
        if arg and wanted[0] == "print":
            self.say(f"  functions: {' '.join(FUNCTIONS)}")
        elif not arg:
            self.say("An empty line repeats the last command; a command's beginning will do.")

    # Completion.

    def complete_print(self, text: str, line: str, *at: int) -> list[str]:
        """Names of quantities and their parts, and functions."""
        start = line[: at[1]].split()[-1] if line[: at[1]].strip() else ""
        word = start[max(start.rfind(c) for c in "([ ,<>=+-*/") + 1 :]
        names = [*self.frame.names(), *(f"{name}(" for name in FUNCTIONS)]
        names += [f"{name}.{part}" for name in self.frame.names() for part in self.frame.parts(name)]
        return [name[len(word) - len(text) :] for name in names if name.startswith(word)]

    complete_display = complete_break = complete_print

    def complete_set(self, text: str, line: str, *at: int) -> list[str]:
        """The estimator's parameters."""
        if not self.branch.parts:
            return []
        return [f"{name}=" for name in self.branch.parts[-1].plan.params if name.startswith(text)]

    def complete_help(self, *typed: Any) -> list[str]:
        return self.completenames(*typed)


def debug(
    name: str,
    *,
    data: list[Path] | None,
    calibration: Path | None,
    settings: list[str],
    seed: int | None,
    viewer: bool,
    stdin: IO[str],
    stdout: IO[str],
) -> None:
    """A session on a scenario, or on a recording."""
    if name.endswith(".rrd"):
        if data or calibration or settings or seed is not None:
            raise BadInput(f"{name}: a recording has its data and parameters; `set K=V` in the session forks it")
        screen = Screen.start() if viewer else Screen(None)
        branch = branches.of_recording(Path(name), screen)
    else:
        planned = plan(name, data=data, calibration=calibration, settings=settings, seed=seed)
        part = forking.Part(0, planned, planned.build())
        screen = Screen.start() if viewer else Screen(None)
        source = Live(part.scenario, planned.seed)
        branch = branches.of_parts(1, planned.title(), [part], source, screen, None)
    Session(branch, screen, stdin, stdout).run()
