"""What is drawn over time, by the types of the fields: the state, its σ and error, innovations, NIS, lanes."""

from __future__ import annotations

from itertools import chain

import numpy as np
import rerun as rr

from viz_estim.core.consistency import band, nis
from viz_estim.core.descriptions import describe
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Step
from viz_estim.core.spaces import SO3, Euclidean, Product, Space
from viz_estim.recording import schema
from viz_estim.recording.batch import Batch, StageRows
from viz_estim.recording.columns import Times, drawn, send_static
from viz_estim.recording.layout import Layout

Series = tuple[str, schema.Colour, Array]  # name, colour, values (N,)


class Plots:
    """Draws batches into the plots and lanes of a stream."""

    def __init__(self, stream: rr.RecordingStream, layout: Layout) -> None:
        self._stream, self._layout = stream, layout
        self._styled: set[str] = set()
        self._known: dict[str, bool] = {}  # by broken line: whether it has a value last
        self._states: dict[str, str] = {}  # by lane: what it shows last

    def add(self, batch: Batch) -> None:
        self._draw_states(batch)
        gated: dict[str, set[int]] = {}  # by sensor: the steps at which a gate refused it
        for rows in batch.stages:
            for field, what in self._layout.stages[rows.name].items():
                if "innovation" in what:
                    self._draw_innovation(rows, field, gated)
        at = (
            Times(*(np.concatenate([getattr(r.at, k) for r in batch.stages]) for k in _TIMELINES))
            if batch.stages
            else None
        )
        if at is not None:
            self._lane("stage", at.pick(np.argsort(at.stage)), list(chain.from_iterable(batch.names)))
        for sensor in self._layout.inputs:
            refused = gated.get(sensor, set())
            self._lane(sensor, batch.times, [_health(step, sensor, refused) for step in batch.steps])

    def _draw_states(self, batch: Batch) -> None:
        """The belief at the end of each step, by part: its components, its σ, its error."""
        ends = [(rows, np.flatnonzero(rows.last)) for rows in batch.stages if rows.last.any()]
        if not ends:
            return
        row = np.concatenate([rows.rows[last] for rows, last in ends])
        order = np.argsort(row)
        row = row[order]
        places = np.concatenate([rows.at.stage[last] for rows, last in ends])[order]
        at = Times(batch.times.step[row], batch.times.time[row], places)
        mean = np.concatenate([rows.array("belief.mean")[last] for rows, last in ends])[order]
        cov = np.concatenate([rows.array("belief.cov")[last] for rows, last in ends])[order]
        variance = np.diagonal(cov, axis1=1, axis2=2)
        truth = batch.truth[row] if self._layout.true_parts else np.broadcast_to(np.nan, mean.shape)
        space = self._layout.space
        for name, part in space.parts.items():
            x, true, var = mean[:, space.at[name]], truth[:, space.at[name]], variance[:, space.axes_at[name]]
            self._plot_state(name, part, at, x, true, var, [batch.steps[i] for i in row.tolist()])
            unit, scale = _shown(part.axis_units[0])
            sigma = scale * np.sqrt(np.maximum(var, 0))
            series = [(axis, schema.AXES[i % 3], sigma[:, i]) for i, axis in enumerate(part.axes)]
            self._plot(schema.plot("sigma", name), at, unit, series)
            if name in self._layout.true_parts:
                error = part.minus(x, true)
                for i, axis in enumerate(part.axes):
                    path = schema.plot("error", f"{name}.{axis}")
                    self._within(path, at, error[:, i], var[:, i], "error", schema.ESTIMATE, part.axis_units[i])

    def _plot_state(
        self, name: str, part: Space, at: Times, x: Array, true: Array, var: Array, steps: list[Step]
    ) -> None:
        """Each component: the estimate with ±1σ where it has one of its own, the truth, and who reads it directly."""
        own_sigma = len(part.names) == len(part.axes)
        reading = self._direct_reading(part, steps)
        if isinstance(part, SO3):
            # q and −q are one rotation: the truth is shown on the estimate's side.
            true = true * np.copysign(1.0, np.nansum(true * x, axis=1, keepdims=True))
        for i, component in enumerate(part.names):
            unit, scale = _shown(part.units[i])
            series: list[Series] = []
            if reading is not None:
                series.append((reading[0], self._colour(reading[0]), scale * reading[1][:, i]))
            series.append(("estimate", schema.ESTIMATE, scale * x[:, i]))
            path = schema.plot("state", f"{name}.{component}")
            self._plot(path, at, unit, series, scale**2 * var[:, i] if own_sigma else None)
            if name in self._layout.true_parts:
                self._broken(f"{path}/truth", at, unit, ("truth", schema.TRUTH, scale * true[:, i]))

    def _direct_reading(self, part: Space, steps: list[Step]) -> tuple[str, Array] | None:
        """The sensor that reads this part of the state as it is (a gyro reads the rate), and its readings."""
        for name, space in self._layout.sensors.items():
            if isinstance(part, Euclidean) and any(part.units) and describe(space) == describe(part):
                nothing = np.full(len(part.names), np.nan)
                return name, np.array([step.tick.measurements.get(name, nothing) for step in steps])
        return None

    def _draw_innovation(self, rows: StageRows, field: str, gated: dict[str, set[int]]) -> None:
        space = getattr(rows.stages[0], field).space
        assert isinstance(space, Product)
        residual, S, used = (rows.array(f"{field}.{k}") for k in ("residual", "cov", "used"))
        found = nis(space, residual, S, rows.array(f"{field}.offered").astype(bool))
        for sensor, (name, part) in enumerate(space.parts.items()):
            refused = rows.at.step[used[:, sensor] == 0]
            if len(refused):
                gated.setdefault(name, set()).update(refused.tolist())
            colour, start = self._colour(name), space.axes_at[name].start
            for i, axis in enumerate(part.axes, start):
                path, unit = schema.plot("innovation", f"{name}.{axis}"), part.axis_units[i - start]
                self._within(path, rows.at, residual[:, i], S[:, i, i], "residual", colour, unit)
            low, high = (np.full(len(rows.at), bound) for bound in band(found[name].dof))
            path = schema.plot("nis", name)
            self._plot(path, rows.at, "", [("97.5 %", schema.BAND, high), ("2.5 %", schema.BAND, low)])
            self._broken(f"{path}/value", rows.at, "", ("NIS", colour, found[name].values))

    def _within(
        self, path: str, at: Times, value: Array, variance: Array, name: str, colour: schema.Colour, unit: str
    ) -> None:
        """A value between the lines at ±3σ that it should stay within."""
        unit, scale = _shown(unit)
        bound = 3 * scale * np.sqrt(np.maximum(variance, 0))
        self._plot(path, at, unit, [("+3σ", schema.BAND, bound), ("−3σ", schema.BAND, -bound)])
        self._broken(f"{path}/value", at, unit, (name, colour, scale * value))

    def _broken(self, path: str, at: Times, unit: str, series: Series) -> None:
        """One line that is broken where its value is NaN: by a row without a value, where the gap begins."""
        name, colour, values = series
        known = np.isfinite(values)
        before = np.concatenate([[self._known.get(path, False)], known[:-1]])
        self._known[path] = bool(known[-1])
        rows = np.flatnonzero(known | before)
        if len(rows):
            at, shown = (at, values) if len(rows) == len(at) and known.all() else (at.pick(rows), values[rows])
            counts = np.isfinite(shown)
            self._style(path, unit, [(name, colour, shown)])
            columns = drawn(rr.Measurements, counts.astype(int), len(at), values=shown[counts])
            rr.send_columns(path, at.columns, columns, recording=self._stream, strict=True)

    def _plot(self, path: str, at: Times, unit: str, series: list[Series], variance: Array | None = None) -> None:
        """Lines in one plot, the last on top; the variance (N,) is that one's, drawn as a band."""
        self._style(path, unit, series)
        components = {"values": np.stack([values for _, _, values in series], axis=1)}
        if variance is not None:
            components["variances"] = np.zeros_like(components["values"])
            components["variances"][:, -1] = variance
        columns = drawn(rr.Measurements, len(series), len(at), **components)
        rr.send_columns(path, at.columns, columns, recording=self._stream, strict=True)

    def _style(self, path: str, unit: str, series: list[Series]) -> None:
        if path not in self._styled:
            self._styled.add(path)
            names, colours, _ = zip(*series, strict=True)
            style = rr.Measurements.from_fields(
                names=names, colors=colours, units=[unit] * len(names), aggregation_policy="MinMax"
            )
            send_static(self._stream, path, style)

    def _lane(self, name: str, at: Times, states: list[str]) -> None:
        """A lane of states, written where they change."""
        changed = [i for i, (a, b) in enumerate(zip([self._states.get(name), *states], states, strict=False)) if a != b]
        if not changed:
            return
        self._states[name] = states[-1]
        path = schema.lane(name)
        meanings = schema.HEALTH if name != "stage" else schema.stage_colours(list(self._layout.stages))
        key = f"{path} {list(meanings)}"
        if key not in self._styled:
            self._styled.add(key)
            style = rr.StateConfiguration(values=list(meanings), colors=list(meanings.values()))
            send_static(self._stream, path, style)
        columns = rr.StateChange.columns(state=[states[i] for i in changed])
        rr.send_columns(path, at.pick(np.array(changed)).columns, columns, recording=self._stream, strict=True)

    def _colour(self, sensor: str) -> schema.Colour:
        return schema.sensor_colour(self._layout.place(sensor))[1]


_TIMELINES = ("step", "time", "stage")


def _shown(unit: str) -> tuple[str, float]:
    """The unit in which a quantity is drawn, and the factor to it: angles in degrees."""
    return ("deg", 180 / np.pi) if unit == "rad" else (unit, 1.0)


def _health(step: Step, sensor: str, gated: set[int]) -> str:
    """What became of a sensor's reading in this step: a key of `schema.HEALTH`, or the fault's own name."""
    tick = step.tick
    if tick.faults and sensor in tick.faults:
        return f"{tick.faults[sensor]}, {'rejected' if sensor in tick.stand_ins else 'used'}"
    if step.index in gated:
        return "gated"
    return "used" if sensor in tick.measurements or sensor in tick.raw else "absent"
