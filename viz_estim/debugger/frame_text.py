"""A debugger's moments as text: where it is, how healthy it is, a quantity with its names and units, what moved it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.consistency import band
from viz_estim.core.measurement import split
from viz_estim.core.quaternions import Array
from viz_estim.debugger.expressions import Absent
from viz_estim.debugger.quantities import Axis, Frame, Quantity

_ROWS = 20  # of a long array that are shown


def place_text(frame: Frame) -> str:
    """Where it is, in one line."""
    name = frame.stage or "no stage"
    return f"step {int(frame.step[0])}  {name}  (stage {int(frame.place[0])})  {float(frame.time[0]):.4f} s"


def health_text(frame: Frame) -> str:
    """How the filter does here, in one line: readings against what was expected, errors against σ."""
    words = [*_nis_words(frame), *_error_words(frame)]
    if (ess := _one(frame, "ess")) is not None:
        words.append(f"ess {ess:.4g} of {frame.particles}")
    if (probability := _get(frame, "probability")) is not None:
        best = int(np.argmax(probability.value[0]))
        words.append(f"{frame.labels[best]} {probability.value[0][best]:.1%}")
    elif (cov := _get(frame, "cov")) is not None and np.isfinite(cov.value).all():
        least = float(np.linalg.eigvalsh(cov.value[0]).min(initial=np.inf))
        if least < 0:
            words.append(f"the covariance has an eigenvalue of {least:.3g}: it is none")
    mean = _get(frame, "mean")
    if mean is not None and not np.isfinite(mean.value).all():
        words.append("the mean is not finite")
    return ";  ".join(words) or "nothing to judge it by at this stage"


def _nis_words(frame: Frame) -> Iterator[str]:
    nis = _get(frame, "nis")
    if nis is None or nis.axes[0] is None:
        return
    residual = frame.quantity("innovation.residual") if "innovation" in frame.spaces else None
    for name, value in zip(nis.axes[0].names, nis.value[0].tolist(), strict=True):
        if not np.isfinite(value):
            continue
        part = residual.part(name) if residual else None
        low, high = band(int(part.value[0].size) if part else 1)
        verdict = "HIGH" if value > high else "low" if value < low else "fine"
        yield f"NIS {name} {value:.3g} ({low:.2g} to {high:.3g}: {verdict})"


def _error_words(frame: Frame) -> Iterator[str]:
    error = _get(frame, "error")
    if error is None or error.axes[0] is None or not np.isfinite(error.value).any():
        return
    groups = dict.fromkeys(name.rpartition(".")[0] for name in error.axes[0].names)
    for group in groups:
        part = error.part(group) if group else error
        if part and part.axes and part.axes[0] and np.isfinite(part.value).all():
            size = float(np.sqrt((part.value**2).sum()))
            std = frame.quantity("std").part(group) if group else frame.quantity("std")
            sure = std is not None and bool((std.value > 0).all())  # else the covariance is zero, or absent
            by = f" ({float(np.abs(part.value / std.value).max()):.2g}σ)" if std and sure else ""
            yield f"error{f' {group}' if group else ''} {_number(size, part.axes[0].units[0])}{by}"
    if (nees := _one(frame, "nees")) is not None:
        yield f"NEES {nees:.3g}"


def quantity_text(name: str, quantity: Quantity) -> str:
    """Its values with names and units: in one line where they are few, else as a table."""
    value, axes = quantity.value[0], quantity.axes
    if value.ndim == 0:
        return f"{name} = {_plain(value)}"
    first = axes[0] if axes else None
    if value.ndim == 1:
        if first:
            cells = zip(first.names, value, first.units, strict=True)
            return f"{name}: " + "  ".join(f"{n}={_number(v, u)}" for n, v, u in cells)
        rest = f"  … {len(value) - _ROWS} more" if len(value) > _ROWS else ""
        return f"{name}: " + "  ".join(_plain(v) for v in value[:_ROWS]) + rest
    if value.ndim > 2:
        return f"{name}: {'×'.join(map(str, value.shape))}; index it, such as {name}[0]"
    return f"{name}:\n" + "\n".join(_table(value, first, axes[1] if len(axes) > 1 else None))


def _table(value: Array, rows: Axis | None, columns: Axis | None) -> Iterator[str]:
    heads = (
        [f"{n} [{u}]" if u else n for n, u in zip(*columns, strict=True)]
        if columns
        else [*map(str, range(value.shape[1]))]
    )
    names = [*rows.names] if rows else [*map(str, range(len(value)))]
    cells = [[_plain(v) for v in row] for row in value[:_ROWS]]
    widths = [max(len(head), *(len(row[j]) for row in cells)) if cells else len(head) for j, head in enumerate(heads)]
    margin = max(map(len, names[:_ROWS]), default=0)
    yield "  " + " " * margin + "".join(f"  {head:>{width}}" for head, width in zip(heads, widths, strict=True))
    for name, row in zip(names, cells, strict=False):
        yield f"  {name:{margin}}" + "".join(f"  {cell:>{width}}" for cell, width in zip(row, widths, strict=True))
    if len(value) > _ROWS:
        yield f"  … {len(value) - _ROWS} more rows"


def names_text(frame: Frame) -> str:
    """Every quantity there is, with its shape and its names."""
    lines = []
    for name in frame.names():
        try:
            quantity = frame.quantity(name)
        except Absent:
            continue
        value = quantity.value
        if value.ndim == 1:
            lines.append(f"  {name:24} {_plain(value[0])}")
            continue
        axis = next((axis for axis in quantity.axes if axis), None)
        words = "  ".join(axis.names[:12]) + (" …" if len(axis.names) > 12 else "") if axis else ""
        lines.append(f"  {name:24} {'×'.join(map(str, value.shape[1:])):8} {words}".rstrip())
    return "\n".join(lines)


def why_text(frame: Frame) -> str:
    """What moved the estimate at this stage: K·ν by component of the reading, largest first in σ of the state before;
    of a stage without a gain, how far it moved."""
    found = [_get(frame, name) for name in ("gain", "innovation.residual", "before.std")]
    gain, residual, std = found
    if gain is not None and residual is not None and std is not None and gain.axes[0] and residual.axes[0]:
        lines = [*_by_reading(gain.value[0], residual, std.value[0], gain.axes[0])]
        used = _get(frame, "innovation.used")
        if used is not None and used.axes[0]:
            gated = [name for name, one in zip(used.axes[0].names, used.value[0], strict=True) if not one]
            lines += [f"  {name} was gated: it moved nothing" for name in gated]
        return "\n".join(["K·ν by component of the reading, largest first (σ of the state before):", *lines])
    if (terms := _get(frame, "log_likelihoods")) is not None and frame.labels and terms.value.ndim == 3:
        return "\n".join(_by_likelihood(frame, terms.value[0]))
    now, earlier = _get(frame, "probability"), _get(frame, "before.probability")
    if now is not None and earlier is not None:
        change = zip(frame.labels, now.value[0] - earlier.value[0], strict=True)
        return f"{frame.stage} changed the probabilities by: " + "  ".join(f"{k} {v:+.3g}" for k, v in change)
    mean, before = _get(frame, "mean"), _get(frame, "before.mean")
    if mean is None or before is None or std is None or frame.space is None:
        return f"nothing moved the estimate at {frame.stage or 'this step'}: it has no gain, and nothing came before"
    axis = Axis(frame.space.axes, frame.space.axis_units)
    moved = _moves(frame.space.minus(mean.value, before.value)[0], std.value[0], axis)
    return f"{frame.stage} took no reading by a gain; it moved the mean by (σ of the state before):\n  {moved}"


def _by_reading(gain: Array, residual: Quantity, std: Array, axis: Axis) -> Iterator[str]:
    moved, in_sigma = split(gain, residual.value[0], std)
    assert residual.axes[0]
    names, units = residual.axes[0]
    width = max(map(len, names))
    for j in np.argsort(-np.abs(in_sigma).max(0)).tolist():
        ν = _number(float(residual.value[0][j]), units[j], "+")
        yield f"  {names[j]:{width}}  ν {ν}:  {_moves(moved[:, j], std, axis)}"


def _by_likelihood(frame: Frame, terms: Array) -> Iterator[str]:
    """Each sensor's term in the log of the probabilities, the most telling sensor first."""
    yield "the readings' log-likelihoods by label, the most telling first:"
    for i in np.argsort(-np.ptp(terms, axis=-1)).tolist():
        cells = zip(frame.labels, terms[i] - terms[i].max(), strict=True)
        yield f"  {frame.sensors[i] if frame.sensors else i}: " + "  ".join(
            f"{label} {_plain(value)}" for label, value in cells
        )


def _moves(moved: Array, std: Array, axis: Axis) -> str:
    """The directions that were moved, those moved most first, none that was moved a hundred times less."""
    sure = bool((std > 0).all())  # else the covariance is zero, or absent
    in_sigma = moved / std if sure else moved
    size = np.abs(in_sigma)
    order = [i for i in np.argsort(-size)[:4].tolist() if size[i] >= 0.01 * size.max()]
    cells = (
        f"{axis.names[i]} {moved[i]:+.3g} {axis.units[i]}".rstrip() + (f" ({in_sigma[i]:+.2g}σ)" if sure else "")
        for i in order
    )
    return "  ".join(cells)


def _get(frame: Frame, name: str) -> Quantity | None:
    try:
        return frame.quantity(name)
    except Absent:
        return None


def _one(frame: Frame, name: str) -> float | None:
    quantity = _get(frame, name)
    value = None if quantity is None else float(quantity.value.reshape(-1)[0])
    return value if value is not None and np.isfinite(value) else None


def _number(value: float, unit: str, sign: str = "") -> str:
    """With its unit; an angle in degrees too."""
    text = f"{value:{sign}.5g} {unit}".rstrip()
    return f"{text} ({np.degrees(value):{sign}.3g}°)" if unit == "rad" and np.isfinite(value) else text


def _plain(value: Array | float) -> str:
    array = np.asarray(value)
    if array.dtype.kind in "fi":
        return f"{float(array):.5g}"
    return str(array.item()).lower() if array.dtype.kind == "b" else str(array.item())
