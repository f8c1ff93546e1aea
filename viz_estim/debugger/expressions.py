"""Expressions on a run's own numbers: read by walking their syntax tree, never run as Python.

An expression holds numbers, texts, dotted names (`mean.attitude`, `nis.accel`), indices, arithmetic, comparisons and
the calls of a few functions. It is worked out for many moments at once: each value is an array (M, …), or (1, …) where
it is the same at all of them.
"""

from __future__ import annotations

import ast
import operator
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.debugger.functions import FUNCTIONS, BadExpression, aligned
from viz_estim.parameters import nearest

Lookup = Callable[[str], Array]
_LONGEST = 1000  # characters; what is longer nests deeper than Python walks


class Absent(BadExpression):
    """It asks for a quantity that this moment hasn't."""


def parse(text: str) -> ast.expr:
    """The expression's syntax tree, all of it allowed; BadExpression where it isn't one, or does what none may."""
    if len(text) > _LONGEST:
        raise BadExpression(f"the expression is longer than {_LONGEST} characters")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Python's, about code that would run
            tree = ast.parse(text.strip(), mode="eval").body
        _check(tree)
    except SyntaxError as error:
        raise BadExpression(f"{text.strip()[:60] or 'nothing'}: no expression ({error.msg})") from error
    except (ValueError, RecursionError, MemoryError) as error:
        if isinstance(error, BadExpression):
            raise
        raise BadExpression("the expression cannot be read") from error
    return tree


def evaluate(tree: ast.expr, lookup: Lookup) -> Array:
    """Its value (M, …). lookup gives a name's values (M, …), or raises Absent."""
    try:
        with np.errstate(all="ignore"):
            return _value(tree, lookup)
    except BadExpression:
        raise
    except (ArithmeticError, ValueError, TypeError, IndexError) as error:
        raise BadExpression(f"{_shown(tree)}: {' '.join(str(error).split())}") from error
    except (RecursionError, MemoryError) as error:
        raise BadExpression("the expression asks for too much") from error


def holds(tree: ast.expr, lookup: Lookup) -> np.ndarray:
    """Where it is true (M,): of an array, where any of its elements is; nowhere if it asks for what isn't there."""
    try:
        value = evaluate(tree, lookup)
    except Absent:
        return np.zeros(1, bool)
    if value.dtype.kind not in "bifu":
        raise BadExpression(f"{_shown(tree)}: a text is neither true nor false")
    return np.asarray((value.astype(bool) & ~np.isnan(value)).reshape(len(value), -1).any(1))


def name_of(node: ast.expr) -> str | None:
    """The quantity that a tree names: `mean.attitude`, or `nis["range/1"]` as nis.range/1; else None."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        head = name_of(node.value)
        return head and f"{head}.{node.attr}"
    if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant) and isinstance(node.slice.value, str):
        head = name_of(node.value)
        return head and f"{head}.{node.slice.value}"
    return None


def _target(node: ast.BinOp) -> str | None:
    """The name that looks like a division: `nis.range/1` is that of the first of several targets, if there is one."""
    head = name_of(node.left) if isinstance(node.op, ast.Div) else None
    if head and isinstance(node.right, ast.Constant) and type(node.right.value) is int:
        return f"{head}/{node.right.value}"
    return None


def names_in(tree: ast.expr) -> list[str]:
    """The quantities that an expression names."""
    if (name := name_of(tree)) is not None:
        return [name]
    children = tree.args if isinstance(tree, ast.Call) else [*ast.iter_child_nodes(tree)]
    return [name for child in children if isinstance(child, ast.expr) for name in names_in(child)]


_BINARY: dict[type[ast.AST], Callable[..., Array]] = {
    ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide, ast.Pow: np.float_power,
    ast.Mod: np.mod, ast.FloorDiv: np.floor_divide,
}  # fmt: skip
_UNARY: dict[type[ast.AST], Callable[..., Array]] = {
    ast.USub: np.negative, ast.UAdd: np.positive, ast.Not: np.logical_not
}  # fmt: skip
_COMPARISONS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge, ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}  # fmt: skip


def _check(node: ast.expr) -> None:
    """BadExpression at the first thing that no expression may do."""
    if (name := name_of(node)) is not None:
        if any(part.startswith("_") for part in name.split(".")):
            raise BadExpression(f"{name}: no quantity's name begins with _")
        return
    if isinstance(node, ast.Attribute):
        raise BadExpression(f"{_shown(node)}: only quantities have parts; .{node.attr} is none of one")
    if isinstance(node, ast.Call):
        if not isinstance(node.func, ast.Name) or node.func.id not in FUNCTIONS:
            raise BadExpression(f"no function {_shown(node.func)}{nearest(_shown(node.func), FUNCTIONS)}")
        count = FUNCTIONS[node.func.id][1]
        if node.keywords or any(isinstance(a, ast.Starred) for a in node.args) or len(node.args) not in (
            (count,) if count else range(1, 100)
        ):  # fmt: skip
            raise BadExpression(f"{node.func.id}() takes {count or 'one or more'} plain argument{'s' * (count != 1)}")
    elif isinstance(node, ast.Subscript):
        _index(node.slice)
        return _check(node.value)
    elif isinstance(node, ast.Constant):
        if not isinstance(node.value, (bool, int, float, str)):
            raise BadExpression(f"{_shown(node)}: only numbers and texts stand in an expression")
    elif not (
        isinstance(node, (ast.BoolOp, ast.Compare))
        or (isinstance(node, ast.BinOp) and type(node.op) in {*_BINARY, ast.MatMult})
        or (isinstance(node, ast.UnaryOp) and type(node.op) in _UNARY)
    ):
        raise BadExpression(f"{_shown(node)}: not allowed in an expression")
    if isinstance(node, ast.Compare) and not all(type(op) in _COMPARISONS for op in node.ops):
        raise BadExpression(f"{_shown(node)}: compare by <, <=, >, >=, == or !=")
    for child in node.args if isinstance(node, ast.Call) else ast.iter_child_nodes(node):
        if isinstance(child, ast.expr):
            _check(child)


def _index(node: ast.expr) -> Any:
    """A constant index: whole numbers, slices of them, or several of these."""
    if isinstance(node, ast.Tuple):
        return tuple(_index(one) for one in node.elts)
    if isinstance(node, ast.Slice):
        return slice(*(None if part is None else _index(part) for part in (node.lower, node.upper, node.step)))
    sign, inner = (-1, node.operand) if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) else (1, node)
    if isinstance(inner, ast.Constant) and type(inner.value) is int:
        return sign * inner.value
    raise BadExpression(f"[{_shown(node)}]: an index is a whole number, such as [0], or a range such as [0:3]")


def _value(node: ast.expr, lookup: Lookup) -> Array:
    if (name := name_of(node)) is not None:
        return lookup(name)
    if isinstance(node, ast.Constant):
        plain = node.value if isinstance(node.value, (bool, str)) else float(node.value)  # type: ignore[arg-type]
        return np.array([plain])
    if isinstance(node, ast.Subscript):
        where = _index(node.slice)
        return _value(node.value, lookup)[(slice(None), *(where if isinstance(where, tuple) else (where,)))]
    if isinstance(node, ast.Call):
        assert isinstance(node.func, ast.Name)
        values = [_numbers(_value(argument, lookup), argument) for argument in node.args]
        return np.asarray(FUNCTIONS[node.func.id][0](*aligned(*values)))
    if isinstance(node, ast.UnaryOp):
        return _UNARY[type(node.op)](_numbers(_value(node.operand, lookup), node))
    if isinstance(node, ast.BinOp):
        if (target := _target(node)) is not None:
            with suppress(Absent):
                return lookup(target)
        a, b = (_numbers(_value(side, lookup), side) for side in (node.left, node.right))
        return _product(a, b) if isinstance(node.op, ast.MatMult) else _BINARY[type(node.op)](*aligned(a, b))
    if isinstance(node, ast.BoolOp):
        return _logic(node, lookup)
    assert isinstance(node, ast.Compare)
    sides = [_value(side, lookup) for side in (node.left, *node.comparators)]
    found: Any = True
    for a, op, b in zip(sides, node.ops, sides[1:], strict=False):
        if (a.dtype.kind == "U") != (b.dtype.kind == "U"):
            raise BadExpression(f"{_shown(node)}: a text compares with texts only")
        found = np.logical_and(
            *aligned(np.asarray(found).reshape(-1), np.asarray(_COMPARISONS[type(op)](*aligned(a, b))))
        )
    return np.asarray(found)


def _logic(node: ast.BoolOp, lookup: Lookup) -> Array:
    """`and`, `or`, where what a moment hasn't is not true; Absent where nothing else is true. What can't change the
    outcome at any moment is not worked out."""
    both = isinstance(node.op, ast.And)
    found = np.array([both])
    missing: Absent | None = None
    for side in node.values:
        if (not found.any()) if both else found.all():
            break
        try:
            value = _numbers(_value(side, lookup), side).astype(bool)
        except Absent as error:
            missing, value = error, np.zeros(1, bool)
        found = (np.logical_and if both else np.logical_or)(*aligned(found, value))
    if missing and not found.any():
        raise missing
    return np.asarray(found)


def _numbers(value: Array, node: ast.expr) -> Array:
    if value.dtype.kind not in "bifu":
        raise BadExpression(f"{_shown(node)}: a text is no number")
    return value if value.dtype.kind == "f" else value.astype(float)


def _product(a: Array, b: Array) -> Array:
    """a @ b of each moment's matrices or vectors."""
    if a.ndim < 2 or b.ndim < 2:
        raise BadExpression("@ is for vectors and matrices")
    left, right = (a[:, None] if a.ndim == 2 else a), (b[..., None] if b.ndim == 2 else b)
    found = left @ right
    found = found[..., 0] if b.ndim == 2 else found
    return found[:, 0] if a.ndim == 2 else found


def _shown(node: ast.expr) -> str:
    """As a person would write it, if it is short."""
    try:
        text = ast.unparse(node)
    except RecursionError:
        return "the expression"
    return text if len(text) <= 60 else f"{text[:57]}…"
