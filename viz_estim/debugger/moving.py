"""Commands that move: by steps and stages, to a moment, and to where a breakpoint holds."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator

import numpy as np

from viz_estim.core.run import failed_where
from viz_estim.debugger import expressions
from viz_estim.debugger.branches import Branch
from viz_estim.debugger.breakpoints import Breakpoint
from viz_estim.debugger.console import Console, Refused, count
from viz_estim.debugger.expressions import Absent
from viz_estim.debugger.findings import HOW, Findings, of_run
from viz_estim.debugger.frame_text import place_text, quantity_text
from viz_estim.debugger.live import Live
from viz_estim.debugger.quantities import Frame, Quantity
from viz_estim.debugger.recorded import Recorded
from viz_estim.debugger.screen import Screen
from viz_estim.debugger.sources import NoSuchPlace

_MOMENT = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*(s?)")


class Moving(Console):
    """Moves the session's place; at each stop it tells where it is, shows what is displayed, moves the viewer."""

    def __init__(self, branch: Branch, screen: Screen, *streams: object) -> None:
        super().__init__(branch, screen, *streams)  # type: ignore[arg-type]
        self._breaks: dict[int, Breakpoint] = {}
        self._count = 0
        self.displayed: list[str] = []
        self._warned: set[str] = set()

    def do_step(self, text: str) -> None:
        """step [N]|N steps on, to the end of that step"""
        self._to_step(self.step + count(text))

    def do_back(self, text: str) -> None:
        """back [N]|N steps back, to the end of that step"""
        self._to_step(self.step - count(text))

    def do_stage(self, text: str) -> None:
        """stage [N], stage back|the next stage, the N-th next, or the one before"""
        place = self.place + (-1 if text == "back" else count(text))
        if place < 0:
            raise Refused("this is the run's first stage")
        try:
            self.go(place)
        except NoSuchPlace:
            raise Refused(f"the run ends here{self._ended()}") from None

    def do_goto(self, text: str) -> None:
        """goto STEP, goto 12.5s|to the end of that step, or of the last one at or before that time"""
        moment = _MOMENT.fullmatch(text)
        if not moment or not (moment[2] or moment[1].isdigit()):
            raise Refused(f"goto {text}: expected a step such as 120, or a time such as 12.5s")
        source = self.branch.source
        self._to_step(source.step_at(float(moment[1])) if moment[2] else int(moment[1][:12]))

    def do_continue(self, text: str) -> None:
        """continue|on to the next place where a breakpoint holds, else to the end"""
        self._look_for_findings()
        source, before, known = self.branch.source, self.branch.source.reached, self._findings()
        try:
            hit = self._first(source.ahead(self.place), last=False)
        except KeyboardInterrupt:
            if source.reached > before:  # it ran: here is how far
                self.say("interrupted")
                self.go(source.span(source.reached)[-1])
                return
            raise
        end = source.span(source.reached)[-1]
        for step, texts in self._findings().items():
            if source.span(step)[-1] <= self.place:
                for text in texts[len(known.get(step, [])) :]:
                    self.say(f"finding since step {step}, before here: {text}")
        if hit and hit[0] <= self.place:  # it is one of these: here is where the evidence is in
            hit = end, hit[1]
        self._stop_at(hit, end, f"the run ends here{self._ended()}")

    def do_reverse(self, text: str) -> None:
        """reverse|back to the last place where a breakpoint held, else to the start"""
        self._look_for_findings()
        hit = self._first(self.branch.source.behind(self.place), last=True)
        self._stop_at(hit, 0, "this is the run's first stage")

    def _to_step(self, step: int) -> None:
        """To the last stage of a step, or to the run's end where it lies beyond."""
        if step < 0:
            raise Refused(f"this is step {self.step}: there is no step {step}")
        source = self.branch.source
        try:
            self.go(source.span(step)[-1])
        except NoSuchPlace:
            end = source.span(source.reached)[-1]
            if self.place != end:
                self.go(end)
            self.say(f"the run ends here{self._ended()}")

    def _first(self, blocks: Iterator[list[Frame]], *, last: bool) -> tuple[int, list[int]] | None:
        """The place nearest to the beginning of the blocks where breakpoints hold, and their numbers."""
        for frames in blocks:
            hits: dict[int, list[int]] = {}
            for frame in frames:
                for number, one in self._breaks.items():
                    for place in frame.place[one.holds(frame)].tolist():
                        hits.setdefault(place, []).append(number)
            if hits:
                place = max(hits) if last else min(hits, key=lambda place: (place <= self.place, place))
                return place, hits[place]
        return None

    def _stop_at(self, hit: tuple[int, list[int]] | None, end: int, why_not: str) -> None:
        if hit:
            for number in hit[1]:
                self.say(f"breakpoint {number}: {self._breaks[number].text}")
        elif self.place == end:
            raise Refused(why_not)
        else:
            self.say("no breakpoint held" if self._breaks else "there are no breakpoints")
        self.go(hit[0] if hit else end)

    def go(self, place: int) -> None:
        """To a place, and tells of it. NoSuchPlace where the run ends before."""
        self.branch.source.frame(place)
        self.place = place
        self.stop()

    def stop(self) -> None:
        """Tells where it is, shows what is displayed, moves the viewer's cursor."""
        self.say(place_text(self.frame) + self.failed())
        source = self.branch.source
        if self.place == source.span(self.step)[-1]:
            for text in self._findings().get(self.step, []):
                self.say(f"finding {text}")
        for text in self.displayed:
            self.say(self.displayable(text))
        if isinstance(source, Live):
            self._warn(source)
        self.screen.seek(self.branch.number, self.place)

    def _warn(self, source: Live) -> None:
        """Tells once what a person should know of a run that goes on."""
        words = []
        if not source.forgetful:
            words.append("this estimator carries on more than its belief: a step done again comes out different")
        if source.findings and source.findings.given_up:
            words.append(f"findings are looked for no longer: {source.findings.given_up}")
        for text in words:
            if text not in self._warned:
                self._warned.add(text)
                self.say(text)

    def failed(self) -> str:
        """A line on what ended the run, where it stands at that place."""
        failure = self.branch.source.failure
        if not failure or self.place != self.branch.source.span(failure.step)[-1]:
            return ""
        return f"\nFAILED {failed_where(failure.stage)}: {' '.join(failure.message.split())}"

    def _ended(self) -> str:
        failure = self.branch.source.failure
        return f": it failed in step {failure.step}" if failure else ""

    # Breakpoints.

    def do_break(self, text: str) -> None:
        """break EXPR|stop where it holds: nis.gps > chi2(2, .999); also `at 12.5s`, `at STEP`, `finding`"""
        if not text:
            raise Refused("break where? For example: break nis.gps > chi2(2, .999)")
        head, _, rest = text.partition(" ")
        moment = _MOMENT.fullmatch(rest.strip()) if head == "at" else None
        if head == "at" and not (moment and (moment[2] or moment[1].isdigit())):
            raise Refused(f"break {text}: expected a step such as at 120, or a time such as at 12.5s")
        if moment:
            one = Breakpoint(text, None, self._step_of(float(moment[1]), bool(moment[2])))
        else:
            one = Breakpoint(text, expressions.parse(text))
            self._look_for_findings(one)
            self._try(one)
        self._count += 1
        self._breaks[self._count] = one
        self.say(f"breakpoint {self._count}: {text}")
        if one.of_findings and isinstance(self.branch.source, Live):
            self.say(HOW)

    def do_breaks(self, text: str) -> None:
        """breaks|lists them"""
        self.say("\n".join(f"{number}: {one.text}" for number, one in self._breaks.items()) or "no breakpoints")

    def do_delete(self, text: str) -> None:
        """delete N|breakpoint N"""
        if not text.isdecimal() or int(text[:9]) not in self._breaks:
            raise Refused(f"no breakpoint {text or 'without a number'}; `breaks` lists them")
        self.say(f"deleted: {self._breaks.pop(int(text)).text}")

    def _step_of(self, moment: float, seconds: bool) -> int:
        """The step of that number, or the first at or after that time."""
        if not seconds:
            return int(moment)
        source = self.branch.source
        times = source.times
        source.step_at(moment)  # NoSuchPlace where it lies outside
        return int(np.searchsorted(times, moment - 5e-10))

    def _try(self, one: Breakpoint) -> None:
        """Refuses what cannot be worked out on the stages that are known; tells of names that none has so far."""
        assert one.tree is not None
        missing: dict[str, Absent] = {}
        known: set[str] = set()
        for frame in self._kinds():
            for name in expressions.names_in(one.tree):
                try:
                    frame.quantity(name)
                    known.add(name)
                except Absent as error:
                    missing[name] = error
            one.holds(frame)
        for name in missing.keys() - known:
            if isinstance(self.branch.source, Recorded):
                raise Refused(f"no stage has {name}: {missing[name]}")
            self.say(f"no stage so far has {name}; {str(missing[name]).rpartition('; ')[2]}")

    def _kinds(self) -> Iterable[Frame]:
        """A moment of each kind of stage, as far as they are known."""
        source = self.branch.source
        if isinstance(source, Recorded):
            return source.one_of_each()
        return [source.frame(place) for k in {0, self.step, source.reached} for place in source.span(k)]

    def _look_for_findings(self, *also: Breakpoint) -> None:
        """Has this branch diagnosed, where a breakpoint asks for findings: a recording at once, a run as it goes on."""
        source = self.branch.source
        wanted = any(one.of_findings for one in (*self._breaks.values(), *also))
        if isinstance(source, Recorded):
            if wanted and source.findings is None:
                source.findings = of_run(source.whole)
        elif isinstance(source, Live):
            assert self.branch.parts
            if not wanted:
                source.findings = None
            elif source.findings is None:
                source.look(Findings(source.scenario, self.branch.parts[-1].plan.all_params()))

    def _findings(self) -> dict[int, list[str]]:
        """What is known to be found, by the step at which it begins."""
        source = self.branch.source
        if isinstance(source, Recorded):
            return source.findings or {}
        return dict(source.findings.begins) if isinstance(source, Live) and source.findings else {}

    # What is displayed.

    def do_display(self, text: str) -> None:
        """display EXPR|print it at every stop; given again: no longer"""
        if text in self.displayed:
            self.displayed.remove(text)
            self.say(f"no longer displayed: {text}")
        elif text:
            expressions.parse(text)
            self.displayed.append(text)
            self.say(self.displayable(text))
        else:
            self.say("\n".join(self.displayed) or "nothing is displayed")

    def displayable(self, text: str) -> str:
        """What an expression gives here, or that it gives nothing here."""
        with contextlib.suppress(Absent):
            return self.worked_out(text)
        return f"{text}: not at this stage"

    def worked_out(self, text: str) -> str:
        """What an expression gives here, as text."""
        tree = expressions.parse(text)
        if (name := expressions.name_of(tree)) is not None:
            return quantity_text(text, self.frame.quantity(name))
        return quantity_text(text, Quantity(expressions.evaluate(tree, self.frame.lookup)))
