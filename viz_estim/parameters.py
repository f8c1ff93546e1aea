"""A function's keyword arguments as parameters on the command line: names, types, defaults, `K=V` texts."""

from __future__ import annotations

import difflib
import inspect
import math
import types
import typing
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from viz_estim.errors import BadInput

# What the command line gives by an option of its own.
_NOT_SET = {"calibration"}


@dataclass(frozen=True)
class Parameter:
    """One keyword argument: its name, type and default."""

    name: str
    kind: Any
    default: Any

    def parse(self, text: str) -> Any:
        """The value that a person's text means; BadInput where it means none."""
        return _parse(self.name, text, self.kind)


def parameters(function: Callable[..., Any]) -> dict[str, Parameter]:
    """The keyword-only arguments of a scenario or of a data function."""
    try:
        hints = typing.get_type_hints(function)
    except Exception:  # a person's own annotations may name what cannot be resolved
        hints = {}
    return {
        p.name: Parameter(p.name, hints.get(p.name, type(p.default)), p.default)
        for p in inspect.signature(function).parameters.values()
        if p.kind is p.KEYWORD_ONLY and p.name not in _NOT_SET
    }


def assign(
    texts: Iterable[str], own: dict[str, Parameter], data: dict[str, Parameter], what: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """`K=V` texts as values of the estimator's and of the data's parameters (`data.K=V`); defaults for the rest."""
    values = {name: p.default for name, p in own.items()}
    data_values = {name: p.default for name, p in data.items()}
    names = [*own, *(f"data.{name}" for name in data)]
    for text in texts:
        name, equals, value = text.partition("=")
        name = name.strip()
        if not equals:
            raise BadInput(f"--set {text}: expected NAME=VALUE")
        if name.startswith("data.") and name[5:] in data:
            data_values[name[5:]] = data[name[5:]].parse(value.strip())
        elif name in own:
            values[name] = own[name].parse(value.strip())
        else:
            raise BadInput(f"{what} has no parameter {name}{nearest(name, names)}")
    return values, data_values


def check_seed(seed: int | None) -> None:
    """BadInput where it is none that a generator takes."""
    if seed is not None and not 0 <= seed < 2**63:
        raise BadInput(f"--seed {seed}: expected a whole number from 0 on, below 2⁶³")


def nearest(name: str, names: Iterable[str]) -> str:
    """ "; did you mean X?", or the names there are."""
    known = list(names)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if close:
        return f"; did you mean {close[0]}?"
    return f" (there are: {', '.join(known)})" if known else " (it has none)"


def kind_text(parameter: Parameter) -> str:
    """The type as a person reads it: `number`, `accel|truth`, `number|none`."""
    return "|".join(_words(parameter.kind))


def _words(kind: Any) -> list[str]:
    if typing.get_origin(kind) is typing.Literal:
        return [str(choice) for choice in typing.get_args(kind)]
    if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
        return [word for part in typing.get_args(kind) for word in _words(part)]
    plain = {float: "number", int: "whole number", bool: "yes|no", str: "text", type(None): "none"}
    return [plain.get(kind, getattr(kind, "__name__", str(kind)))]


def _parse(name: str, text: str, kind: Any) -> Any:
    if typing.get_origin(kind) is typing.Literal:
        for choice in typing.get_args(kind):
            if text == str(choice):
                return choice
    elif isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
        for part in sorted(typing.get_args(kind), key=lambda part: part is str):
            try:
                return _parse(name, text, part)
            except BadInput:
                continue
    elif kind is type(None):
        if text.lower() in ("none", ""):
            return None
    elif kind is bool:
        if text.lower() in ("yes", "true", "1", "no", "false", "0"):
            return text.lower() in ("yes", "true", "1")
    elif kind is str:
        return text
    elif kind in (int, float):
        try:
            number = kind(text)
        except ValueError:
            pass
        else:
            if math.isfinite(number):
                return number
    raise BadInput(f"{name}={text}: expected {' or '.join(_words(kind))}")
