"""The house's rule: who may import what, read from the modules' text; and no module grows beyond 300 lines."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import viz_estim

HOUSE = Path(viz_estim.__file__).parent
MODULES = {path.relative_to(HOUSE.parent).with_suffix("").as_posix(): path for path in sorted(HOUSE.rglob("*.py"))}
every_module = pytest.mark.parametrize("module", MODULES)


@cache
def calls_and_imports(path: Path) -> list[ast.Call | ast.Import | ast.ImportFrom]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return [node for node in ast.walk(tree) if isinstance(node, ast.Call | ast.Import | ast.ImportFrom)]


@cache
def called(node: ast.Call) -> str:
    return ast.unparse(node.func)


def imports(module: str) -> Iterator[str]:
    """The full names of all that a module imports, wherever in it: `from a import b` gives a.b."""
    package = module.split("/")[:-1]
    for node in calls_and_imports(MODULES[module]):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = [] if node.level == 0 else package[: len(package) - node.level + 1]
            yield from (".".join([*base, *([node.module] if node.module else []), alias.name]) for alias in node.names)
        elif called(node) in ("__import__", "importlib.import_module"):
            # A name made at run time can't be judged here: only a person's own file is imported like this, by its path.
            yield from (arg.value for arg in node.args[:1] if isinstance(arg, ast.Constant))


def foreign(module: str, *allowed: str) -> list[str]:
    """What the module imports beyond the standard library, and beyond packages or names allowed with all below them."""

    def fine(name: str) -> bool:
        return name.split(".")[0] in sys.stdlib_module_names or any(f"{name}.".startswith(f"{a}.") for a in allowed)

    return [name for name in imports(module) if not fine(name)]


def room(name: str) -> list[str]:
    modules = [module for module in MODULES if module.startswith(f"viz_estim/{name}/")]
    assert modules, f"no room {name}"
    return modules


@pytest.mark.parametrize("module", room("core"))
def test_the_core_knows_numpy_scipy_and_itself(module: str) -> None:
    assert foreign(module, "numpy", "scipy", "viz_estim.core") == []


@pytest.mark.parametrize("module", room("scenarios"))
def test_scenarios_know_the_core_and_the_error_for_bad_input(module: str) -> None:
    known = ("viz_estim.core", "viz_estim.errors", "viz_estim.files", "viz_estim.scenarios")
    assert foreign(module, "numpy", "scipy", *known) == []


@pytest.mark.parametrize("module", room("recording"))
def test_the_recording_knows_no_scenario_and_nothing_above_it(module: str) -> None:
    known = ("viz_estim.core", "viz_estim.errors", "viz_estim.files", "viz_estim.recording")
    assert [name for name in foreign(module, *known) if name.split(".")[0] == "viz_estim"] == []


@every_module
def test_only_the_recording_imports_rerun_and_pyarrow(module: str) -> None:
    heads = {name.split(".")[0] for name in imports(module)}
    assert module in room("recording") or not heads & {"rerun", "rerun_bindings", "rerun_cli", "pyarrow"}


@every_module
def test_nothing_is_unpickled(module: str) -> None:
    assert not {name.split(".")[0] for name in imports(module)} & {"pickle", "dill", "joblib", "shelve", "marshal"}
    for node in calls_and_imports(MODULES[module]):
        if isinstance(node, ast.Call):
            allowed = [k.value for k in node.keywords if k.arg == "allow_pickle"]
            allowed += node.args[2:3] if called(node) in ("np.load", "numpy.load") else []
            assert all(isinstance(value, ast.Constant) and value.value is False for value in allowed)
            assert called(node) not in ("read_pickle", "np.core.multiarray._reconstruct", "eval", "exec")


@every_module
def test_no_module_is_longer_than_300_lines(module: str) -> None:
    assert len(MODULES[module].read_text(encoding="utf-8").splitlines()) <= 300


def test_the_rule_sees_imports_of_every_form(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    text = "import a.b as c\nfrom d import e\nfrom . import f\nfrom ..g import h\ndef i(): import j\n__import__('k')\n"
    (tmp_path / "one.py").write_text(text)
    monkeypatch.setitem(MODULES, "viz_estim/core/one", tmp_path / "one.py")
    assert sorted(imports("viz_estim/core/one")) == ["a.b", "d.e", "j", "k", "viz_estim.core.f", "viz_estim.g.h"]
    assert foreign("viz_estim/core/one", "a", "d.e", "viz_estim.core") == ["viz_estim.g.h", "j", "k"]


def test_the_command_line_starts_without_scipy_stats() -> None:
    """Importing it takes longer than all else together."""
    loaded = "import sys, viz_estim.cli; print('scipy.stats' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
