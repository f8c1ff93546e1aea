"""What is drawn over time, by the types of the fields: the state, its σ and error, probabilities, lanes."""

from __future__ import annotations

import numpy as np
import rerun as rr

from viz_estim.core.descriptions import describe
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Tick
from viz_estim.core.spaces import SO3, Euclidean, Space
from viz_estim.recording import schema
from viz_estim.recording.batch import Batch
from viz_estim.recording.columns import Times, drawn, send, send_static, words
from viz_estim.recording.innovations import Innovations
from viz_estim.recording.layout import Layout
from viz_estim.recording.lines import Lines, Series, shown, sigma_plots
from viz_estim.recording.readings import told


class Plots:
    """Draws batches into the plots and lanes of a stream."""

    def __init__(self, stream: rr.RecordingStream, layout: Layout) -> None:
        self._stream, self._layout = stream, layout
        self._lines = Lines(stream, layout.ranges)
        self._innovations = Innovations(self._lines, layout)
        self._styled: set[str] = set()
        self._states: dict[str, str] = {}  # by lane: what it shows last

    def add(self, batch: Batch) -> None:
        if batch.stages:
            if self._layout.labels:
                self._draw_probabilities(batch)
            else:
                self._draw_states(batch)
            self._lane("stage", batch.at, [rows.name for rows in batch.stages], batch.in_order)
        self._draw_figures(batch)
        gated = self._innovations.add(batch)
        for sensor in self._layout.inputs:
            self._draw_health(batch, sensor, gated.get(sensor, set()))

    def _draw_states(self, batch: Batch) -> None:
        """The belief at the end of each step, by part: its components, its σ, its error."""
        at, row = batch.at.pick(batch.ends), batch.end_rows
        mean, cov = batch.end_moments
        variance = np.diagonal(cov, axis1=1, axis2=2)
        truth = batch.truth[row] if self._layout.true_parts else np.broadcast_to(np.nan, mean.shape)
        space = self._layout.space
        for name, part in space.parts.items():
            x, true, var = mean[:, space.at[name]], truth[:, space.at[name]], variance[:, space.axes_at[name]]
            self._plot_state(name, part, at, x, true, var, self._direct_reading(batch, name, part))
            sigma, colours = np.sqrt(np.maximum(var, 0)), schema.line_colours(len(part.axes))
            for plot, axes in sigma_plots(name, part).items():
                unit, scale = shown(part.axis_units[axes[0]])
                series = [(part.axes[i], colours[i], scale * sigma[:, i]) for i in axes]
                self._lines.draw(schema.plot("sigma", plot), at, unit, series)
            if name in self._layout.true_parts:
                error, gapless = part.minus(x, true), name in self._layout.gapless
                for i, axis in enumerate(part.axes):
                    path = schema.plot("error", f"{name}.{axis}")
                    line = ("error", schema.ESTIMATE, error[:, i])
                    self._lines.within(path, at, part.axis_units[i], line, var[:, i], gapless=gapless)

    def _plot_state(
        self, name: str, part: Space, at: Times, x: Array, true: Array, var: Array, reading: tuple[str, Array] | None
    ) -> None:
        """Each component: the estimate with ±1σ where it has one of its own, the truth, and who reads it directly."""
        own_sigma = len(part.names) == len(part.axes)
        if isinstance(part, SO3):
            # q and −q are one rotation: the truth is shown on the estimate's side.
            true = true * np.copysign(1.0, np.nansum(true * x, axis=1, keepdims=True))
        for i, component in enumerate(part.names):
            unit, scale = shown(part.units[i])
            path = schema.plot("state", f"{name}.{component}")
            series: list[Series] = []
            if reading is not None:
                read = (reading[0], self._colour(reading[0]), scale * reading[1][:, i])
                self._lines.broken(f"{path}/reading", at, unit, read, path)
            true_line = ("truth", schema.TRUTH, scale * true[:, i])
            if name in self._layout.gapless:
                series.append(true_line)
            series.append(("estimate", schema.ESTIMATE, scale * x[:, i]))
            self._lines.draw(path, at, unit, series, scale**2 * var[:, i] if own_sigma else None)
            if name in self._layout.true_parts and name not in self._layout.gapless:
                self._lines.broken(f"{path}/truth", at, unit, true_line, path)

    def _direct_reading(self, batch: Batch, name: str, part: Space) -> tuple[str, Array] | None:
        """The sensor that reads this part of the state as it is (a gyro reads the rate), and its readings by step."""
        for sensor, space in self._layout.sensors.items():
            if isinstance(part, Euclidean) and any(part.units) and describe(space) == describe(part):
                nothing = np.full(len(part.names), np.nan)
                read = np.array(
                    [batch.steps[i].tick.measurements.get(sensor, nothing) for i in batch.end_rows.tolist()]
                )
                for rows in batch.stages:
                    for field, what in self._layout.stages[rows.name].items():
                        if "innovation" in what and sensor in getattr(rows.stages[0], field).space.parts:
                            untold = rows.at.step[~told(self._layout, rows, field, sensor, name)]
                            read[np.isin(batch.times.step[batch.end_rows], untold)] = np.nan
                return sensor, read
        return None

    def _draw_figures(self, batch: Batch) -> None:
        """The single numbers of stages, such as the effective sample size, or the RMSE of a fit."""
        for rows in batch.stages:
            for field, what in self._layout.stages[rows.name].items():
                if what.get("shape") == []:
                    line = (field, schema.ESTIMATE, rows.array(field))
                    self._lines.broken(schema.plot("figure", f"{rows.name}.{field}"), rows.at, "", line)

    def _draw_probabilities(self, batch: Batch) -> None:
        """The probability of each label after each step as lines, after each stage as bars; the true label's beside."""
        labels = self._layout.labels
        p = np.exp(batch.beliefs("log_probabilities"))
        colours = schema.line_colours(len(labels))
        at, last = batch.at, batch.ends
        series = [(label, colours[i], p[last, i]) for i, label in enumerate(labels)]
        self._lines.draw(schema.plot("probability", "labels"), at.pick(last), "", series)
        heights = np.maximum(p, 1e-4)
        x = np.broadcast_to(schema.BAR * np.arange(len(labels)), p.shape)
        centers = np.stack([x, 0.5 * heights, np.zeros_like(p)], axis=-1)
        sizes = np.stack([np.full_like(p, 0.4 * schema.BAR), 0.5 * heights, np.full_like(p, 0.01)], axis=-1)
        if schema.BARS not in self._styled:
            self._styled.add(schema.BARS)
            style = rr.Boxes3D.from_fields(colors=colours, labels=list(labels), show_labels=True, fill_mode="Solid")
            send_static(self._stream, f"{schema.BARS}/probability", style)
            ends = -0.6 * schema.BAR, (len(labels) - 0.4) * schema.BAR
            axis = [[[ends[0], y, 0], [ends[1], y, 0]] for y in (0.0, 0.5, 1.0)]
            send_static(self._stream, f"{schema.BARS}/axis", rr.LineStrips3D(axis, colors=[schema.BAND], radii=[-0.5]))
            marks = rr.Points3D([line[1] for line in axis], colors=[schema.BAND], radii=[-1], labels=["0", "½", "1"])
            send_static(self._stream, f"{schema.BARS}/marks", marks)
        columns = drawn(rr.Boxes3D, len(labels), len(at), half_sizes=sizes, centers=centers)
        send(self._stream, f"{schema.BARS}/probability", at, columns)
        if any(step.truth is not None for step in batch.steps):
            known = np.isfinite(batch.truth[:, 0])
            which = np.where(known, batch.truth[:, 0], len(labels)).astype(int)
            self._lane("truth", batch.times, [*labels, ""], which)

    def _lane(self, name: str, at: Times, states: list[str], which: np.ndarray) -> None:
        """A lane of states, written where they change; which (M,) says by its place what each row's is."""
        last = self._states.get(name)
        first = states.index(last) if last in states else -1
        changed = np.flatnonzero(np.diff(which, prepend=first))
        if not len(changed):
            return
        self._states[name] = states[which[-1]]
        path = schema.lane(name)
        meanings = schema.HEALTH
        if name == "stage":
            meanings = schema.stage_colours(list(self._layout.stages))
        elif name == "truth":
            meanings = dict(zip(self._layout.labels, schema.line_colours(len(self._layout.labels)), strict=True))
        key = f"{path} {list(meanings)}"
        if key not in self._styled:
            self._styled.add(key)
            style = rr.StateConfiguration(values=list(meanings), colors=list(meanings.values()))
            send_static(self._stream, path, style)
        send(self._stream, path, at.pick(changed), [words(rr.StateChange, "state", states, which[changed])])

    def _colour(self, sensor: str) -> schema.Colour:
        return schema.sensor_colour(self._layout.place(sensor))[1]

    def _draw_health(self, batch: Batch, sensor: str, gated: set[int]) -> None:
        """What became of a sensor's reading in each step, as a lane; nothing where none was due."""
        states = [*(_health(tick, sensor) for tick in batch.ticks), "gated", "absent"]
        which, step = batch.tick_kind.copy(), batch.times.step
        faulty = np.array([sensor in tick.faults for tick in batch.ticks])[which]
        there = np.array([bool(state) for state in states])
        which[np.isin(step, list(gated)) & ~faulty] = len(states) - 2
        which[np.isin(step, list(self._layout.silent.get(sensor, ()))) & ~there[which]] = len(states) - 1
        due = np.flatnonzero(there[which])
        if len(due):
            texts = list(dict.fromkeys(states))  # ticks of several kinds may have it in one state
            self._lane(sensor, batch.times.pick(due), texts, np.array([texts.index(s) for s in states])[which[due]])


def _health(tick: Tick, sensor: str) -> str:
    """What became of a reading that no gate refused: a key of `schema.HEALTH`, or the fault's own name."""
    if sensor in tick.faults:
        return f"{tick.faults[sensor]}, {'rejected' if sensor in tick.stand_ins else 'used'}"
    return "used" if sensor in tick.measurements or sensor in tick.raw else ""
