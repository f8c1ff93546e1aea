"""The house's rule: who may import what, read from the modules' text; and no module grows beyond 300 lines."""

import ast
import subprocess
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import pytest

import viz_estim

HOUSE = Path(viz_estim.__file__).parent
MODULES = {path.relative_to(HOUSE.parent).with_suffix("").as_posix(): path for path in sorted(HOUSE.rglob("*.py"))}


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


def strangers(modules: Iterable[str], *allowed: str) -> dict[str, list[str]]:
    """By module, what is foreign to it."""
    return {module: found for module in modules if (found := foreign(module, *allowed))}


def test_the_core_knows_numpy_scipy_and_itself() -> None:
    assert strangers(room("core"), "numpy", "scipy", "viz_estim.core") == {}


def test_scenarios_know_the_core_and_the_error_for_bad_input() -> None:
    known = ("viz_estim.core", "viz_estim.errors", "viz_estim.files", "viz_estim.scenarios")
    assert strangers(room("scenarios"), "numpy", "scipy", *known) == {}


def test_the_recording_knows_no_scenario_and_nothing_above_it() -> None:
    known = ("viz_estim.core", "viz_estim.errors", "viz_estim.files", "viz_estim.recording")
    found = strangers(room("recording"), *known)
    assert not [(module, name) for module in found for name in found[module] if name.split(".")[0] == "viz_estim"]


def test_only_the_recording_imports_rerun_and_pyarrow() -> None:
    recording = room("recording")
    heads = {module: {name.split(".")[0] for name in imports(module)} for module in MODULES if module not in recording}
    assert not [module for module in heads if heads[module] & {"rerun", "rerun_bindings", "rerun_cli", "pyarrow"}]


def test_nothing_is_unpickled() -> None:
    picklers = {"pickle", "dill", "joblib", "shelve", "marshal"}
    assert not {module for module in MODULES if picklers & {name.split(".")[0] for name in imports(module)}}
    for module, path in MODULES.items():
        for node in calls_and_imports(path):
            if isinstance(node, ast.Call):
                allowed = [k.value for k in node.keywords if k.arg == "allow_pickle"]
                allowed += node.args[2:3] if called(node) in ("np.load", "numpy.load") else []
                false = all(isinstance(value, ast.Constant) and value.value is False for value in allowed)
                assert false, f"{module}: line {node.lineno}"
                unsafe = ("read_pickle", "np.core.multiarray._reconstruct", "eval", "exec")
                assert called(node) not in unsafe, f"{module}: line {node.lineno}"


def test_no_module_is_longer_than_300_lines() -> None:
    lengths = {module: len(path.read_text(encoding="utf-8").splitlines()) for module, path in MODULES.items()}
    assert not {module: length for module, length in lengths.items() if length > 300}


def test_the_rule_sees_imports_of_every_form(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    text = "import a.b as c\nfrom d import e\nfrom . import f\nfrom ..g import h\ndef i(): import j\n__import__('k')\n"
    (tmp_path / "one.py").write_text(text)
    monkeypatch.setitem(MODULES, "viz_estim/core/one", tmp_path / "one.py")
    assert sorted(imports("viz_estim/core/one")) == ["a.b", "d.e", "j", "k", "viz_estim.core.f", "viz_estim.g.h"]
    assert foreign("viz_estim/core/one", "a", "d.e", "viz_estim.core") == ["viz_estim.g.h", "j", "k"]


def test_what_takes_long_to_import_is_left_to_who_uses_it() -> None:
    """`list` is there in half a second: rerun takes another one, scipy's parts two. `import scipy` brings none."""
    loaded = "import sys, viz_estim.cli; viz_estim.cli.main(['list']); print('\\n', sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, check=True)
    modules = ast.literal_eval(done.stdout.splitlines()[-1].strip())
    assert {"numpy", "scipy", "viz_estim.scenarios"} <= set(modules)
    parts = ("io", "ndimage", "optimize", "spatial", "special", "stats")
    assert not {"rerun", "pyarrow", *(f"scipy.{part}" for part in parts)} & set(modules)


def test_parts_of_scipy_are_imported_by_their_use() -> None:
    assert not [(module, name) for module in MODULES for name in imports(module) if name.startswith("scipy.")]
