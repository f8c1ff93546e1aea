"""The debugger as it is used: scripts on stdin, a terminal, a viewer beside it; back is exact, no slip ends it."""

import contextlib
import dataclasses
import io
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import SHORT, Cli
from test_survival import FAILING

import viz_estim
from viz_estim.core.run import Step, run
from viz_estim.debugger import branches, findings, forking, recorded
from viz_estim.debugger.branches import Branch
from viz_estim.debugger.live import Beliefs, Live
from viz_estim.debugger.recorded import Recorded
from viz_estim.debugger.screen import Screen
from viz_estim.debugger.session import Session
from viz_estim.diagnose import diagnose
from viz_estim.recording import reader
from viz_estim.recording.memory import collect
from viz_estim.recording.reader import Run
from viz_estim.recording.viewer import Viewer
from viz_estim.running import Plan, plan

# A filter that uses chance in each step, skips its update at some, and fails where it is told to.
WALK = """
import numpy as np
from viz_estim.core.beliefs import Gaussian
from viz_estim.core.run import Scenario, Tick
from viz_estim.core.spaces import Euclidean, Product
from viz_estim.core.stages import Innovation, Stage, Update

Z = Product(gps=Euclidean(["x"], "m"))

class Walk:
    def __init__(self, q, r, fails):
        self.q, self.r, self.fails = q, r, fails

    def step(self, belief, tick, rng):
        x, P, one = belief.mean, belief.cov, np.ones(1, bool)
        if tick.dt:
            x, P = x + 0.01 * rng.standard_normal(1), P + self.q
            yield Stage("predict", Gaussian(belief.space, x, P))
        if "gps" not in tick.measurements:
            return
        if tick.time > self.fails:
            np.linalg.cholesky(-P)
        z, S = tick.measurements["gps"], P + self.r
        K = P / S
        innovation = Innovation(Z, z, x, z - x, S, np.full((1, 1), self.r), P, one, one, np.zeros((1, 1)))
        yield Update("update", Gaussian(belief.space, x + K[0] * (z - x), (1 - K) * P), innovation, K)

def walk(
    rng, *, q: float = 0.1, r: float = 0.25, start: float = 1.0, fails: float = 99.0, noise: float = 0.5,
    count: int = 40,
):
    truth = np.cumsum(0.3 * rng.standard_normal((count, 1)), axis=0)
    z = truth + noise * rng.standard_normal((count, 1))
    ticks = [
        Tick(0.1 * k, 0.1 * (k > 0), measurements={"gps": z[k]} if k % 3 != 1 else {}) for k in range(count)
    ]
    belief = Gaussian(Product(position=Euclidean(["x"], "m")), np.zeros(1), np.full((1, 1), start))
    return Scenario(Walk(q, r, fails), {0: belief}, ticks, truth)
"""


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("walk") / "walk.py"
    path.write_text(WALK)
    return f"{path}:walk"


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Branches are recorded where one is."""
    monkeypatch.chdir(tmp_path)


def planned(name: str, *settings: str, seed: int | None = 1) -> Plan:
    return plan(name, data=None, calibration=None, settings=list(settings), seed=seed)


def live_branch(name: str, *settings: str, screen: Screen | None = None, seed: int | None = 1) -> Branch:
    made = planned(name, *settings, seed=seed)
    part = forking.Part(0, made, made.build())
    return branches.of_parts(1, "live", [part], Live(part.scenario, made.seed), screen or Screen(None), None)


class Told(Session):
    """A session in this process: `do("step")` gives the lines that it told."""

    def __init__(self, branch: Branch, script: str = "", screen: Screen | None = None) -> None:
        self.text = io.StringIO()
        super().__init__(branch, screen or Screen(None), io.StringIO(script), self.text)

    def do(self, *commands: str) -> list[str]:
        at = self.text.tell()
        for command in commands:
            self.onecmd(command)
        return self.text.getvalue()[at:].splitlines()


def script(cli: Cli, monkeypatch: pytest.MonkeyPatch, name: object, text: str, *options: object) -> list[str]:
    """What a script on stdin makes the command line tell."""
    monkeypatch.setattr("sys.stdin", io.StringIO(text))
    done = cli("debug", name, "--no-viewer", *options)
    assert (done.code, done.err) == (0, "")
    return done.out.splitlines()


def test_a_script_on_stdin_moves_looks_and_changes(cli: Cli, walk: str, monkeypatch: pytest.MonkeyPatch) -> None:
    told = script(
        cli, monkeypatch, walk,
        """step
step 2

stage
back 3
goto 1.25s
where
why
print mean.position
display nis.gps
bre at 20
c
set q=0.5
compare
branches
switch 1
nonsense
print mean.speed
""",
        "--seed", 1,
    )  # fmt: skip
    assert told[:5] == [
        "step 0  start  (stage 0)  0.0000 s",
        "step 1  predict  (stage 2)  0.1000 s",
        "step 3  update  (stage 6)  0.3000 s",
        "step 5  update  (stage 9)  0.5000 s",  # an empty line repeats
        "step 6  predict  (stage 10)  0.6000 s",
    ]
    text = "\n".join(told)
    for words in (
        "step 12  update  (stage 21)", "NIS gps", "K·ν by component", "gps.x  ν", "mean.position: x=", "nis.gps = ",
        "breakpoint 1: at 20", "step 20  predict", "branch 2: q=0.5 from step 20 on", "position_rmse_m", "nis gps",
        "first difference: step 20, predict: cov", "* 2: q=0.5 from step 20 on (of branch 1); to step 20",
        "error: no command nonsense", "error: no mean.speed at stage", "branch 2: recordings/walk-seed1-debug-2.rrd",
    ):  # fmt: skip
        assert words in text, words
    for name in ("walk-seed1-debug", "walk-seed1-debug-2"):
        assert viz_estim.load(Path("recordings") / f"{name}.rrd").complete


def test_a_recording_tells_what_the_filter_tells(
    cli: Cli, walk: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "walk.rrd"
    assert cli("run", walk, "--seed", 1, "--out", out).code == 0
    commands = "names\ngoto 30\nwhere\nwhy\nstage back\nwhy\nprint cov\nprint before.mean\nprint truth\nprint z.gps\n"
    commands += (
        "break nis.gps > 2\nreverse\nreverse\ncontinue\nbreak error.position < 0.1\nc\nc\nstep 99\nset q=0.2\nc\n"
    )
    commands += "reverse\nbreak stage == 'update' and step < 9\nreverse\nbreak blah > 0\ncompare 1\n"
    live, recorded_ = (
        script(cli, monkeypatch, name, commands, *more) for name, more in ((walk, ["--seed", 1]), (out, []))
    )
    differs = [pair for pair in zip(live, recorded_, strict=False) if pair[0].split() != pair[1].split()]
    names = [name for name in live if name.startswith("  ")]
    assert set(names) >= {line for line in recorded_ if line.startswith("  innovation.")}
    # The order of the names, what is said of a name that nobody has, and the branches' files.
    assert all(any(w in a + b for w in ("blah", "branch", "  mean ", "  cov ", "before", "z.gps")) for a, b in differs)


@pytest.mark.parametrize(
    "expression",
    [
        "nis.gps > 1",
        "error.position > 0.4",
        "cov[0, 0] < 0.13",
        'stage == "update"',
        "before.mean > mean",
        "time > 1.05",
    ],
)
def test_continue_stops_at_each_place_where_it_holds_and_nowhere_else(cli: Cli, walk: str, expression: str) -> None:
    assert cli("run", walk, "--seed", 1, "--out", "walk.rrd").code == 0
    for branch in (live_branch(walk), branches.of_recording(Path("walk.rrd"), Screen(None))):
        session = Told(branch)
        session.do("step 99")
        total = session.place + 1
        holds = []
        for place in range(total):
            session.place = place
            holds += [place] if session.do(f"print {expression}")[-1].endswith("true") else []
        session.place = 0
        session.do(f"break {expression}")
        found = []
        while "ends here" not in (told := session.do("continue"))[-1] and "no breakpoint" not in told[0]:
            found.append(session.place)
        assert found == [place for place in holds if place > 0]
        back = []
        while session.place:
            session.do("reverse")
            back.append(session.place)
        assert sorted({*back} - {0}) == [place for place in found if place < total - 1 and place > 0]


EXPRESSIONS = [
    "mean", "cov", "std", "nis", "error", "nees", "mean[0]", "cov[0, 0]", "gain", "sigma", "innovation.gps", "foo",
    "1/0", "min(eig(cov))", "ess", "N", "step", "stage == 'update'", "before.mean", "((", "innovation.residual[7]",
    "mean @ mean", "x" * 3000, "chi2(1, .9)", "z.gps", "truth", "nis.gps > 1", "error.position", "'", "deg(3) * time",
]  # fmt: skip
COMMANDS = [
    "step", "step 3", "back", "back 2", "stage", "stage 2", "stage back", "goto {k}", "goto {t}s", "continue",
    "reverse", "break {e} > {x}", "break at {k}", "break at {t}s", "delete {n}", "breaks", "print {e}", "display {e}",
    "names", "where", "why", "set {p}={y}", "set q={y} r={y}", "set", "branches", "switch {n}", "compare",
    "compare {n}", "help", "help st", "", "bogus", "set data.q=1", "set q", "set 'q", "break", "save", "save x.txt",
    "goto", "goto -3", "step -1", "\x00", "print", "sw", "?", "step 1 2", "back 99", "step 99", "stage 9999",
    "delete", "switch", "b", "c", "p mean", "break finding", "break finding and step > {k}", "print finding",
]  # fmt: skip


def random_script(rng: np.random.Generator, length: int) -> str:
    def one_of(choices: list[str]) -> str:
        return choices[rng.integers(len(choices))]

    lines = []
    for _ in range(length):
        words = {
            "k": rng.integers(0, 30), "t": f"{rng.uniform(-1, 4):.3f}", "n": rng.integers(0, 5),
            "x": f"{rng.normal():.2f}", "y": one_of(["0.05", "0.30", "-1.00"]), "e": one_of(EXPRESSIONS),
            "p": one_of(["q", "r", "start", "noise", "fails", "quux"]),
        }  # fmt: skip
        line = one_of(COMMANDS)
        for key, word in words.items():
            line = line.replace(f"{{{key}}}", str(word))
        lines.append(line)
    return "\n".join(lines)


class Watching(Told):
    """Keeps what stood at each place of each branch, and where it was another when it came there again."""

    def __init__(self, branch: Branch, text: str) -> None:
        super().__init__(branch, text)
        self.stood: dict[tuple[int, int], dict[str, bytes]] = {}
        self.changed: list[tuple[int, int]] = []

    def stop(self) -> None:
        super().stop()
        found = {name: np.asarray(self.frame.values[name]).tobytes() for name in self.frame.values}
        if self.stood.setdefault((self.branch.number, self.place), found) != found:
            self.changed.append((self.branch.number, self.place))


class NoFile:
    """In place of a branch's recording, where two hundred of them are not what is tested."""

    path = Path("nothing")

    def __init__(self, *arguments: object) -> None: ...

    def add(self, step: object) -> None: ...

    def close(self) -> None: ...


@pytest.mark.parametrize("seed", range(100))
def test_no_script_ends_it_and_every_back_is_exact(
    seed: int, cli: Cli, walk: str, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    rng = np.random.default_rng(seed)
    if seed % 20:
        monkeypatch.setattr(branches, "File", NoFile)
    settings = ["count=24", *(["fails=1.5"] if seed % 4 == 0 else [])]
    if seed % 3:
        branch = live_branch(walk, *settings)
    else:
        kept = tmp_path_factory.getbasetemp() / f"walk{len(settings)}.rrd"
        if not kept.exists():
            assert cli("run", walk, "--seed", 1, *(f"--set={one}" for one in settings), "--out", kept).code == 0
        branch = branches.of_recording(kept, Screen(None))
    session = Watching(branch, random_script(rng, 25))
    session.run()
    told = session.text.getvalue()
    assert session.changed == []
    assert "Traceback" not in told
    # A slip of ours would be told by the exception's type; `step` raises what the filter does, as the run's failure.
    slips = re.findall(r"^error: [A-Za-z]*(?:Error|Exception|Warning|Interrupt): .*", told, re.MULTILINE)
    assert slips == []
    # Every live branch is what a run of its parts gives, from its first step to its last.
    for one in session.branches:
        if isinstance(one.source, Live) and one.parts and len(one.parts) == 1:
            for step, again in zip(one.source.steps(), run(one.parts[0].scenario, one.source.seed), strict=False):
                assert len(step.stages) == len(again.stages)
                for a, b in zip(step.stages, again.stages, strict=True):
                    assert a.belief.mean.tobytes() == b.belief.mean.tobytes()


def test_going_back_costs_no_bit_where_chance_draws(tmp_path: Path) -> None:
    session = Watching(live_branch("beacons-pf", seed=None), "")
    session.do("step 30", "back 12", "stage", "stage", "stage", "step 4", "back 22", "step 11", "reverse", "goto 17")
    session.do(*["stage"] * 60, *["back"] * 20, *["stage back"] * 5)
    assert len(session.stood) > 60
    assert session.changed == []


def test_where_memory_is_short_back_is_exact_too(walk: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Beliefs.__init__, "__defaults__", (100,))
    session = Watching(live_branch(walk), "")
    session.do("step 25", *["stage back"] * 40, "step 39", *["back"] * 39, "goto 21", "set q=0.3", "step 9", "back 20")
    assert len(session.branch.source._beliefs._kept) < 8  # type: ignore[attr-defined]
    assert len(session.stood) > 50
    assert session.changed == []


def test_an_interrupt_stops_where_the_filter_got_to(walk: str) -> None:
    session = Watching(live_branch(walk), "")
    assert session.branch.file
    told, when = session.branch.file.add, [8, 20]

    def interrupted(step: Step) -> None:
        if step.index == when[0]:
            when.pop(0)
            raise KeyboardInterrupt
        told(step)

    session.branch.source.told = interrupted  # type: ignore[attr-defined]
    when.append(99)
    assert session.do("continue")[:2] == ["interrupted", "step 8  update  (stage 14)  0.8000 s"]
    assert session.do("continue")[0] == "interrupted"
    assert session.do("continue")[-1].startswith("step 39  update")
    session.do(*["back"] * 39)
    assert session.changed == []
    session.branch.file.close()
    assert viz_estim.load(session.branch.file.path).step.tolist() == list(range(40))


def test_an_estimator_that_carries_on_more_than_its_belief_is_found_out(tmp_path: Path) -> None:
    text = WALK.replace("x, P = x + 0.01", "self.n = getattr(self, 'n', 0) + 1; x, P = x + self.n * 0.01")
    (tmp_path / "own.py").write_text(text)
    session = Told(live_branch(f"{tmp_path}/own.py:walk"))
    assert "carries on more" not in "\n".join(session.do("step 9"))
    told = "\n".join(session.do("step 9", "back 12", "back 2"))
    assert told.count("this estimator carries on more than its belief") == 1


def test_findings_stop_a_run_that_goes_on_once_the_evidence_is_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(branches, "File", NoFile)
    session = Told(live_branch("imu-ukf", *SHORT, seed=3))
    assert session.do("break finding and step > 60")[1].startswith("of a run that goes on, findings are looked for")
    told = session.do("continue")
    frozen = session.step
    assert told[-1].startswith("finding sensor_frozen of gyro")
    assert session.branch.source.reached > frozen + 50
    assert all(
        line.startswith("finding since step ") for line in told[: told.index("breakpoint 1: finding and step > 60")]
    )
    session.do("back", "step")  # what is known is told, and stopped at, wherever it is passed again
    assert session.do("back 9", "continue")[-1] == told[-1]
    # A branch knows what was known where it parts, and looks on by itself.
    session.do("set frozen=reject")
    assert "sensor_frozen" not in str(session._findings())


def test_a_finding_that_began_behind_stops_where_the_evidence_is(walk: str, monkeypatch: pytest.MonkeyPatch) -> None:
    session = Told(live_branch(walk, "noise=9"))
    session.do("step 7", "break finding")
    told = session.do("continue")
    assert told[0].startswith("finding since step 0, before here: overconfident of gps")
    assert told[-2:] == ["breakpoint 1: finding", "step 39  update  (stage 66)  3.9000 s"]
    assert any(line.startswith("finding overconfident of gps") for line in session.do("reverse"))
    # At the end it has what a diagnosis of the whole run has.
    source = session.branch.source
    assert isinstance(source, Live)
    assert source.findings
    assert session.branch.parts
    known = {(one.code, one.sensor) for _, one in source.findings._known}
    whole = diagnose(collect(source.scenario, source.steps(), session.branch.parts[-1].plan.all_params()))
    assert {(one.code, one.sensor) for one in whole} == known
    session.do("delete 1", "reverse", "continue")
    assert session._findings() == {}
    # Whatever a diagnosis does costs no session.
    with monkeypatch.context() as patch:
        patch.setattr(findings, "diagnose", lambda run: 1 / 0)
        told = session.do("break finding", "goto 0", "continue")
    assert sum("the diagnosis raised ZeroDivisionError" in line for line in told) == 1
    monkeypatch.setattr(findings, "_MOST", 100)
    told = Told(live_branch(walk)).do("step", "break finding", "continue", "back", "continue")
    assert sum("take more than 1 GB" in line for line in told) == 1


@pytest.mark.parametrize(("fate", "stage"), [("raises", "predict"), ("is NaN", "correct")])
def test_post_mortem(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fate: str, stage: str) -> None:
    (tmp_path / "my.py").write_text(FAILING)
    done = cli("run", f"{tmp_path}/my.py:walk", "--set", f"fate={fate}", "--out", "failed.rrd")
    assert done.out.splitlines()[-1] == "viz-estim debug failed.rrd"
    told = script(cli, monkeypatch, "failed.rrd", "where\nback\nstep\nstep\n")
    assert told[0].startswith(f"step 7  {stage}  ")
    assert told[1].startswith("FAILED ")
    good = next(line for line in told if line.startswith("the last good belief"))
    assert "step 7  predict" in good
    text = "\n".join(told)
    assert "mean: x=8 m" in text if fate == "raises" else "mean: x=" in text
    assert "the run ends here: it failed in step 7" in text
    live = script(cli, monkeypatch, f"{tmp_path}/my.py:walk", "continue\nwhere", "--set", f"fate={fate}")
    assert sum(line.startswith("FAILED ") for line in live) == 2


def test_a_failure_is_gone_on_from_with_other_parameters(cli: Cli, walk: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cli("run", walk, "--seed", 1, "--set", "fails=2.5", "--out", "failed.rrd").code == 0
    told = script(cli, monkeypatch, "failed.rrd", "set fails=99\ncontinue\nswitch 1\nwhere")
    assert told[0].startswith("step 26  predict")
    assert "step 39  update  (stage 66)  3.9000 s" in told
    assert sum(line.startswith("FAILED after predict: LinAlgError") for line in told) == 3


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("b 3", "b: back, break, breaks or branches?"), ("wh", "wh: where or why?"),
        ("continue 3", "continue takes nothing after it"), ("break at", "expected a step such as at 120"),
        ("break at 1.5", "expected a step such as at 120"), ("break mean._x > 0", "no quantity's name begins with _"),
        ("print before.foo", "no before.foo; there are before.mean, before.cov"), ("set =1", "expected NAME=VALUE"),
        ("save recordings/walk-seed1-debug.rrd", "is where branch 1 is being recorded"),
        ("save 'recordings/walk-seed1-debug.partial.rrd'", "is where branch 1 is being recorded"),
    ],
)  # fmt: skip
def test_a_slip_is_one_line(walk: str, line: str, words: str) -> None:
    session = Told(live_branch(walk))
    session.do("step 3")
    (told,) = session.do(line)
    assert told.startswith("error: ")
    assert words in told


def test_two_sessions_at_once_record_into_files_of_their_own(walk: str) -> None:
    sessions = [Told(live_branch(walk)) for _ in range(2)]
    for session in sessions:
        session.do("step 20", "set r=2", "step 5")
    for session in sessions:
        session.do("step 3")
    paths = [branch.file.path for session in sessions for branch in session.branches if branch.file]
    assert len({*paths}) == 4
    for session in sessions:
        for branch in session.branches:
            assert branch.file
            branch.file.close()
            assert len(viz_estim.load(branch.file.path).step) == branch.source.reached + 1


def test_a_file_that_was_cut_has_whole_steps_alone(recording: Path, tmp_path: Path) -> None:
    data, opened = recording.read_bytes(), 0
    for offset in np.random.default_rng(3).integers(1000, len(data), 6):
        (tmp_path / "cut.rrd").write_bytes(data[:offset])
        with contextlib.suppress(viz_estim.errors.BadInput):
            session = Told(branches.of_recording(tmp_path / "cut.rrd", Screen(None)))
            told = session.do("continue", "where", "why", "back", "stage", "names", "reverse")
            assert not [line for line in told if "no stage" in line or "Error" in line]
            opened += 1
    assert opened


def test_abbreviations_repeats_and_the_end(walk: str) -> None:
    session = Told(live_branch(walk), "s\n\n\nbreak at 9\nc\np step\nstag back\nn\nq\nstep 3\n")
    session.loop()
    told = session.text.getvalue()
    assert told.count("step 1  predict") == told.count("step 2  update") == told.count("step 3  update") == 1
    assert "step = 9" in told
    assert session.step == 8
    assert "step 12" not in told  # nothing after quit


def test_tab_completes(walk: str) -> None:
    session = Told(live_branch(walk))
    session.do("goto 5")
    assert session.completenames("st") == ["step", "stage"]
    line = "print error.po"
    assert "error.position" in session.complete_print("error.po", line, 6, len(line))
    line = "break nis.gps > ch"
    assert session.complete_break("ch", line, 16, len(line)) == ["chi2("]
    assert session.complete_set("st", "set st", 4, 6) == ["start="]


def test_what_set_refuses_says_why(walk: str) -> None:
    session = Told(live_branch(walk))
    session.do("goto 9")
    for setting, words in {
        "start=3": "belongs to the start", "noise=1": "changes the data", "data.x=1": "belongs to the data",
        "qq=1": "no parameter qq; did you mean q?", "q=x": "expected number", "q": "expected NAME=VALUE",
    }.items():  # fmt: skip
        (line,) = session.do(f"set {setting}")
        assert line.startswith("error: ")
        assert words in line
    assert len(session.branches) == 1
    session.do("goto 0")
    assert session.do("set start=3")[0].startswith("branch 2: start=3 from step 0 on")
    assert session.do("stage back", "print cov[0, 0]")[-1] == "cov[0, 0] = 3"


def test_set_forks_and_keeps_the_old_branch(walk: str, tmp_path: Path) -> None:
    session = Watching(live_branch(walk), "")
    session.do("step 39", "goto 20", "set r=2", "step 19", "save two.rrd", "switch 1", "save one.rrd")
    one, two = (viz_estim.load(f"{name}.rrd") for name in ("one", "two"))
    np.testing.assert_array_equal(one.mean[:20], two.mean[:20])
    assert (one.mean[20:] != two.mean[20:]).any()
    other = planned(walk, "r=2").build()
    scenario = planned(walk).build()
    steps = [*run(scenario, 1)][:20]
    rest = run(other, 1, first=20, belief=steps[-1].stages[-1].belief)
    ends = [step.stages[-1].belief.mean for step in (*steps, *rest)]
    np.testing.assert_array_equal(two.mean, ends)
    assert session.changed == []


@pytest.mark.usefixtures("no_display")
def test_without_a_display_it_says_so_once(cli: Cli, walk: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("step\nstep\n"))
    done = cli("debug", walk, "--seed", 1)
    assert done.code == 0
    assert done.err.count("\n") == 1
    assert "without a viewer" in done.err
    assert "step 2  update" in done.out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere.rrd"], "nowhere.rrd: no such recording"),
        (["imu-ufk"], "did you mean imu-ukf?"),
        (["some.rrd", "--seed", "3"], "a recording has its data and parameters"),
        (["imu-ukf", "--set", "foo=1"], "no parameter foo"),
    ],
)
def test_what_cannot_be_debugged_is_one_line(cli: Cli, arguments: list[str], words: str) -> None:
    done = cli("debug", *arguments, "--no-viewer")
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert words in done.err


def tiled(found: Run, times: int) -> Run:
    """The same steps over and over: a long run."""
    count = len(found.step)
    k = np.arange(times * count)
    most = 1 + max(int(table.place[-1]) for table in found.stages.values())
    tables = {
        name: dataclasses.replace(
            table,
            step=np.concatenate([table.step + i * count for i in range(times)]),
            place=np.concatenate([table.place + i * most for i in range(times)]),
            values={k: np.tile(v, (times, *[1] * (v.ndim - 1))) for k, v in table.values.items()},
        )
        for name, table in found.stages.items()
    }

    def again(values: np.ndarray) -> np.ndarray:
        return np.tile(values, (times, *[1] * (values.ndim - 1)))

    return dataclasses.replace(
        found, step=k, time=np.asarray(0.1 * k, float), dt=again(found.dt), truth=again(found.truth),
        inputs={name: again(v) for name, v in found.inputs.items()}, stages=tables,
        ends={name: again(v) for name, v in found.ends.items()},
    )  # fmt: skip


def test_a_long_recording_is_searched_in_blocks_and_without_its_clouds(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load, times = reader.load, 1 + 50_000 // len(viz_estim.load(recording).step)
    monkeypatch.setattr(recorded, "load", lambda path, *, points=True: tiled(load(path, points=points), times))
    source = Recorded(recording)
    assert len(source.run.step) >= 50_000
    assert not any(name.endswith(".points") for table in source.run.stages.values() for name in table.values)
    assert len(list(source.ahead(0))) <= len(source.run.step) / 5000  # expressions are evaluated once in each
    session = Told(Branch(1, "long", 0, None, source))
    session.do("break nis.accel > 1e9")
    assert session.do("continue")[0] == "no breakpoint held"
    assert session.step == source.reached
    assert "whole" not in vars(source)
    assert session.do("print sigma[0, 0]")  # asked for, they are read
    assert "whole" in vars(source)


def wait_for(path: Path, seconds: float = 30) -> None:
    deadline = time.monotonic() + seconds
    while not path.exists() and time.monotonic() < deadline:
        time.sleep(0.02)


def test_killed_at_any_moment_the_branch_s_file_opens(walk: str) -> None:
    code = "import sys; from viz_estim.cli import main; main(sys.argv[1:])"
    arguments = ["debug", walk, "--seed", "1", "--no-viewer"]
    streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    children = []
    for wait in (0.0, 0.7):
        folder = Path(f"after{wait}")
        folder.mkdir()
        child = subprocess.Popen([sys.executable, "-c", code, *arguments], text=True, cwd=folder, **streams)  # type: ignore[call-overload]
        children.append((wait, folder, child))
        child.stdin.write("step 12\nset q=0.4\nstep 5\n")
        child.stdin.flush()
    for wait, folder, child in children:
        for line in child.stdout:
            if line.startswith("step 17"):
                break
        time.sleep(wait)
        child.send_signal(signal.SIGKILL)
        child.communicate()
        left = list(folder.glob("recordings/*.partial.rrd"))
        assert len(left) == 2
        for path in left:
            with contextlib.suppress(viz_estim.errors.BadInput):  # killed before its first second
                found = viz_estim.load(path)
                assert not found.complete
                if wait:
                    assert found.step[-1] == (17 if "-2" in path.name else 12)


class Terminal:
    """The command line in a real terminal."""

    def __init__(self, *arguments: object) -> None:
        self.pid, self.fd = pty.fork()
        if self.pid == 0:
            os.environ.update(TERM="xterm", COLUMNS="200")
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # which a test run in the background may ignore
            code = "import sys; from viz_estim.cli import main; sys.exit(main(sys.argv[1:]))"
            os.execv(sys.executable, [sys.executable, "-c", code, *map(str, arguments)])
        self.seen = ""

    def read(self, until: str, seconds: float = 30) -> str:
        """What it shows up to and with a text."""
        deadline, shown = time.monotonic() + seconds, ""
        while until not in shown and time.monotonic() < deadline:
            if select.select([self.fd], [], [], 0.1)[0]:
                try:
                    shown += os.read(self.fd, 65536).decode()
                except OSError:  # it has ended
                    break
        self.seen += shown
        assert until in shown, self.seen
        return shown

    def type(self, keys: str, until: str = "(viz-estim) ") -> str:
        os.write(self.fd, keys.encode())
        return self.read(until)


def test_the_readme_s_session_is_as_it_ran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    readme = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    session = readme.partition("<!-- a session, typed in a terminal -->\n```\n")[2].partition("```")[0]
    start, *turns = session.split("(viz-estim) ")
    monkeypatch.chdir(tmp_path)
    terminal = Terminal(*start.splitlines()[0].split()[2:], "--no-viewer")
    terminal.read("(viz-estim) ")
    assert len(turns) == 10
    for turn in turns:
        command, *lines = turn.splitlines()
        shown = terminal.type(f"{command}\n", lines[-1][:60] if command == "quit" else "(viz-estim) ")
        for line in lines:
            assert line == "  …" or line[:60] in shown, shown
    os.waitpid(terminal.pid, 0)


def test_a_session_in_a_real_terminal(recording: Path) -> None:
    """The README's: ten commands, a completion by TAB, the history, an interrupt."""
    terminal = Terminal("debug", recording, "--no-viewer")
    terminal.read("(viz-estim) ")
    assert "step 200  update" in terminal.type("goto 200\n")
    assert "K·ν by component" in terminal.type("why\n")
    assert "stage back" in terminal.type("stage back\n")
    assert "qw=" in terminal.type("print mean.att\t\n")
    assert "breakpoint 1" in terminal.type("break nis.accel > chi2(3, .999)\n")
    assert "breakpoint 1: nis.accel" in terminal.type("continue\n")
    first = terminal.type("where\n")
    assert "NIS accel" in first
    assert "HIGH" in first
    assert "frozen" in terminal.type("set frozen=reject\n")
    assert "* 2: frozen=reject" in terminal.type("branches\n")
    terminal.type("step 40\n")
    assert "first difference" in terminal.type("compare\n")
    assert "* 2: frozen=reject" in terminal.type("\x1b[A\x1b[A\x1b[A\n")  # three commands before
    assert "error: no command nope" in terminal.type("nope\n")
    time.sleep(0.3)  # until readline listens: an interrupt before that waits for the next key
    assert "interrupted" in terminal.type("\x03")
    terminal.type("quit\n", "branch 2: recordings/")
    assert os.waitpid(terminal.pid, 0)[1] == 0
    assert "Traceback" not in terminal.seen


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    with Viewer.start(headless=True, size=(300, 200)) as started:
        yield started


@pytest.mark.draws
def test_the_viewer_s_cursor_stands_where_the_session_does(walk: str, viewer: Viewer) -> None:
    screen = Screen(viewer)
    session = Told(live_branch(walk, screen=screen), screen=screen)
    session.stop()
    moves = ["step", "stage", "step 5", "back 2", "goto 30", "set r=2", "step 3", "switch 1", "back", "switch 2"]
    for command in moves:
        session.do(command)
        assert screen.settle(20)
        assert viewer.cursor() == ("stage", session.place), command
    os.killpg(viewer._process.pid, signal.SIGKILL)
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors):
        told = session.do("step", "step 2", "set q=0.3", "step", "switch 1", "step 9", "compare 2")
        assert screen.settle()
    assert errors.getvalue() == "viz-estim: the viewer is gone; going on without it\n"
    assert not [line for line in told if line.startswith("error")]
    for branch in session.branches:
        assert branch.file
        branch.file.close()
        found = viz_estim.load(branch.file.path)
        assert found.step.tolist() == list(range(branch.source.reached + 1))


@pytest.mark.draws
def test_a_recording_is_shown_beside_its_session(recording: Path, viewer: Viewer) -> None:
    screen = Screen(viewer)
    session = Told(branches.of_recording(recording, screen), screen=screen)
    for command in [
        "goto 100",
        "stage back",
        "break nis.accel > 20",
        "continue",
        "set frozen=reject",
        "step 2",
        "switch 1",
    ]:
        session.do(command)
        assert screen.settle(20)
        assert viewer.cursor() == ("stage", session.place), command
    session.branches[1].file.close()  # type: ignore[union-attr]
