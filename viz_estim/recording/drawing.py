"""What a person sees, drawn from the records by the types of their fields: bodies, sigma points, plots, lanes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import rerun as rr

from viz_estim.core import quaternions
from viz_estim.core.consistency import band, nis
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Step
from viz_estim.core.spaces import S2, SO3, Euclidean, Product, Space, describe
from viz_estim.core.stages import Innovation, SigmaPoints, Stage
from viz_estim.recording import schema
from viz_estim.recording.columns import Times, partition
from viz_estim.recording.layout import Layout, as_product

_DEFAULT_BODY = (0.6, 0.4, 0.15)


class Drawing:
    """Draws batches of steps into a stream; remembers what the last stage left on the screen."""

    def __init__(self, stream: rr.RecordingStream, layout: Layout, scenario: Scenario) -> None:
        self._stream, self._layout = stream, layout
        self._styled: set[str] = set()
        self._paths: dict[str, set[tuple[str, str]]] = {}  # by stage: the geometry it draws, as (path, kind)
        self._last: tuple[str, ...] = ()  # the stages whose geometry the last step drew
        self._last_stage = ""
        self._states: dict[str, str] = {}
        body = scenario.scenery.get("body")
        self._body = np.array(body.sizes if body else _DEFAULT_BODY) / 2
        if any(isinstance(part, SO3) for part in layout.space.parts.values()):
            stream.log(schema.WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            self._sphere(f"{schema.WORLD}/sphere", 1.0)

    def add(self, steps: list[Step], times: Times, counts: np.ndarray, every: int) -> None:
        """Draws steps whose first stages are at `times` and that have `counts` places on the stage timeline."""
        stages = [(row, times.stage[row] + i, s) for row, step in enumerate(steps) for i, s in enumerate(step.stages)]
        if stages:
            rows = np.array([row for row, _, _ in stages])
            at = Times(times.step[rows], times.time[rows], np.array([place for _, place, _ in stages]))
            self._draw_states(steps, times, counts)
            self._draw_bodies(steps, times, at, [stage for _, _, stage in stages])
            self._draw_stages(at, [stage for _, _, stage in stages], every)
            self._clear(steps, times, every)
            self._lane("stage", at, [stage.name for _, _, stage in stages])
        for sensor in self._layout.inputs:
            self._lane(sensor, times, [_health(step, sensor) for step in steps])

    # --- plots -------------------------------------------------------------------------------------------------------

    def _draw_states(self, steps: list[Step], times: Times, counts: np.ndarray) -> None:
        """The belief at the end of each step, by part: its components, its σ, its error."""
        rows = np.array([row for row, step in enumerate(steps) if step.stages])
        at = Times(times.step[rows], times.time[rows], times.stage[rows] + counts[rows] - 1)
        ended = [steps[row] for row in rows]
        mean = np.stack([step.stages[-1].belief.mean for step in ended])
        variance = np.stack([np.diagonal(step.stages[-1].belief.cov) for step in ended])
        nothing = np.full(mean.shape[1], np.nan)
        truth = np.stack([nothing if step.truth is None else step.truth for step in ended])
        space = self._layout.space
        for name, part in space.parts.items():
            x, true, var = mean[:, space.at[name]], truth[:, space.at[name]], variance[:, space.axes_at[name]]
            reading = self._direct_reading(part, ended)
            self._plot_state(name, part, at, x, true, var, reading)
            unit, scale = _shown(part.axis_units[0])
            colours = [schema.AXES[i % 3] for i in range(len(part.axes))]
            sigma = scale * np.sqrt(np.maximum(var, 0))
            self._plot(schema.plot("sigma", name), at, sigma, None, list(part.axes), colours, unit)
            if self._layout.has_truth and np.isfinite(true).any():
                error = part.minus(x, true)
                for i, axis in enumerate(part.axes):
                    self._within(schema.plot("error", f"{name}.{axis}"), at, error[:, i], var[:, i], "error",
                                 schema.ESTIMATE, part.axis_units[i])  # fmt: skip

    def _plot_state(
        self, name: str, part: Space, at: Times, x: Array, true: Array, var: Array, reading: tuple[str, Array] | None
    ) -> None:
        flat = isinstance(part, Euclidean) or len(part.names) == len(part.axes) == 1
        if isinstance(part, SO3):
            # q and −q are one rotation: the truth is shown on the estimate's side.
            true = true * np.copysign(1.0, np.nansum(true * x, axis=1, keepdims=True))
        for i, component in enumerate(part.names):
            unit, scale = _shown(part.units[i])
            values, variances, names, colours = (
                [x[:, i]],
                [var[:, i] if flat else 0 * x[:, i]],
                ["estimate"],
                [schema.ESTIMATE],
            )
            if self._layout.has_truth:
                values.append(true[:, i])
                names.append("truth")
                colours.append(schema.TRUTH)
            if reading is not None:
                values.append(reading[1][:, i])
                names.append(reading[0])
                colours.append(self._colour(reading[0]))
            variances += [np.zeros(len(at))] * (len(values) - 1)
            self._plot(schema.plot("state", f"{name}.{component}"), at, scale * np.stack(values, 1),
                       scale**2 * np.stack(variances, 1), names, colours, unit)  # fmt: skip

    def _direct_reading(self, part: Space, steps: Sequence[Step]) -> tuple[str, Array] | None:
        """The sensor that reads this part of the state as it is (a gyro reads the rate), and its readings."""
        for name, space in self._layout.sensors.items():
            if isinstance(part, Euclidean) and any(part.units) and describe(space) == describe(part):
                nothing = np.full(len(part.names), np.nan)
                return name, np.stack([step.tick.measurements.get(name, nothing) for step in steps])
        return None

    def _within(
        self, path: str, at: Times, value: Array, variance: Array, name: str, colour: schema.Colour, unit: str
    ) -> None:
        """A value between the lines at ±3σ that it should stay within."""
        unit, scale = _shown(unit)
        bound = 3 * np.sqrt(np.maximum(variance, 0))
        values = scale * np.stack([bound, -bound, value], axis=1)
        self._plot(path, at, values, None, ["+3σ", "−3σ", name], [schema.BAND, schema.BAND, colour], unit)

    def _plot(
        self, path: str, at: Times, values: Array, variances: Array | None, names: list[str],
        colours: list[schema.Colour], unit: str,
    ) -> None:  # fmt: skip
        """Series (N, k) into one plot."""
        if path not in self._styled:
            self._styled.add(path)
            style = rr.Measurements.from_fields(
                names=names, colors=colours, units=[unit] * len(names), aggregation_policy="MinMax"
            )
            self._stream.log(path, style, static=True)
        columns = rr.Measurements.columns(
            values=values.ravel(), variances=None if variances is None else variances.ravel()
        )
        self._send(path, at, columns, values.shape[1])

    # --- geometry ----------------------------------------------------------------------------------------------------

    def _draw_bodies(self, steps: list[Step], times: Times, at: Times, stages: list[Stage]) -> None:
        """The body and its axes: the estimate after each stage, the truth once a step."""
        space = self._layout.space
        for name, part in space.parts.items():
            if isinstance(part, SO3):
                q = np.stack([stage.belief.mean[space.at[name]] for stage in stages])
                self._body_at("estimate", at, q, schema.ESTIMATE, 1.0)
                if self._layout.has_truth:
                    nothing = np.full(4, np.nan)
                    q = np.stack([nothing if s.truth is None else s.truth[space.at[name]] for s in steps])
                    self._body_at("truth", times, q, schema.TRUTH, 1.25)

    def _body_at(self, name: str, at: Times, q: Array, colour: schema.Colour, reach: float) -> None:
        box, axes = f"{schema.WORLD}/{name}", f"{schema.WORLD}/{name}/axes"
        if box not in self._styled:
            self._styled.add(box)
            self._stream.log(
                box,
                rr.Boxes3D.from_fields(colors=[colour], labels=[name], show_labels=False, radii=[0.006]),
                static=True,
            )
            thin = 0.012 if name == "estimate" else 0.006
            colours = [tuple(np.add(c, schema.TRUTH) // 2) for c in schema.AXES] if name == "truth" else schema.AXES
            self._stream.log(axes, rr.Arrows3D.from_fields(colors=colours, radii=[thin] * 3), static=True)
        known = np.isfinite(q).all(1)
        R = quaternions.to_matrix(q[known])
        self._send(box, at, rr.Boxes3D.columns(
            half_sizes=np.tile(self._body, (len(R), 1)), quaternions=xyzw(q[known])
        ), known.astype(int))  # fmt: skip
        tips = reach * np.swapaxes(R, -1, -2).reshape(-1, 3)
        self._send(axes, at, rr.Arrows3D.columns(vectors=tips), 3 * known.astype(int))

    def _draw_stages(self, at: Times, stages: list[Stage], every: int) -> None:
        """Innovations of every stage, and its sigma points at every N-th step."""
        by_name: dict[str, list[int]] = {}
        for i, stage in enumerate(stages):
            by_name.setdefault(stage.name, []).append(i)
        for name, indices in by_name.items():
            rows = [stages[i] for i in indices]
            when = at.pick(np.array(indices))
            kept = np.flatnonzero(when.step % every == 0)
            for field, what in self._layout.stages[name].items():
                values = [getattr(stage, field) for stage in rows]
                if "innovation" in what:
                    self._draw_innovation(name, when, values, kept)
                elif "points" in what and len(kept):
                    self._draw_points(name, field, when.pick(kept), [values[i] for i in kept])

    def _draw_points(self, stage: str, field: str, at: Times, values: list[SigmaPoints]) -> None:
        points = np.stack([v.points for v in values])
        space = as_product(values[0].space)
        for name, part in space.parts.items():
            x = points[..., space.at[name]]
            if isinstance(part, SO3):
                tips = np.swapaxes(quaternions.to_matrix(x), -1, -2).reshape(-1, 3)
                count = 3 * points.shape[1]
                faint = 0.55 if field == "drawn" else 1.0  # what a prediction starts from stands back
                shades = (faint * np.array(schema.AXES)).astype(int)
                colours: list[schema.Colour] = [tuple(shades[i % 3]) for i in range(count)]
                self._geometry(
                    stage, schema.drawn(stage, field), at, "points", tips, count, colours, 0.014 / faint**0.5
                )
            elif name in self._layout.sensors and len(part.names) == 3:
                path = f"{schema.sensor(name)}/{field}"
                size = np.median(np.linalg.norm(x[0], axis=-1)) or 1.0
                self._geometry(
                    stage, path, at, "points", x.reshape(-1, 3), points.shape[1], [schema.ESTIMATE], 0.014 * size
                )

    def _draw_innovation(self, stage: str, at: Times, values: list[Innovation], kept: np.ndarray) -> None:
        space = values[0].space
        stacked = {
            k: np.stack([getattr(v, k) for v in values]) for k in ("z", "predicted", "residual", "cov", "offered")
        }
        found = nis(space, stacked["residual"], stacked["cov"], stacked["offered"])
        for name, part in space.parts.items():
            colour = self._colour(name)
            for i, axis in enumerate(part.axes):
                j = space.axes_at[name].start + i
                self._within(schema.plot("innovation", f"{name}.{axis}"), at, stacked["residual"][:, j],
                             stacked["cov"][:, j, j], "residual", colour, part.axis_units[i])  # fmt: skip
            low, high = band(found[name].dof)
            lines = np.stack([np.full(len(at), high), np.full(len(at), low), found[name].values], axis=1)
            self._plot(schema.plot("nis", name), at, lines, None, ["97.5 %", "2.5 %", "NIS"],
                       [schema.BAND, schema.BAND, colour], "")  # fmt: skip
            if len(part.names) == 3 and isinstance(part, (Euclidean, S2)) and len(kept):
                self._draw_vectors(stage, name, at.pick(kept), space, stacked, kept)

    def _draw_vectors(
        self, stage: str, name: str, at: Times, space: Product, stacked: dict[str, Array], kept: np.ndarray
    ) -> None:
        """A reading of three components and what was expected of it, as arrows in the sensor's own space."""
        z, expected = stacked["z"][kept][:, space.at[name]], stacked["predicted"][kept][:, space.at[name]]
        size = float(np.linalg.norm(expected[0]))
        path = schema.sensor(name)
        if path not in self._styled and size > 1e-3:
            self._styled.add(path)
            self._sphere(f"{path}/sphere", size)
        thick = 0.012 * (size if size > 1e-3 else 1.0)
        self._geometry(stage, f"{path}/measured", at, "arrows", z, 1, [self._colour(name)], thick)
        self._geometry(stage, f"{path}/predicted", at, "arrows", expected, 1, [schema.ESTIMATE], thick)

    def _geometry(
        self, stage: str, path: str, at: Times, kind: str, rows: Array, count: int, colours: Sequence[schema.Colour],
        radius: float,
    ) -> None:  # fmt: skip
        """Points or arrows that stand while their stage does: `_clear` takes them away."""
        if path not in self._styled:
            self._styled.add(path)
            self._paths.setdefault(stage, set()).add((path, kind))
            shape = rr.Points3D if kind == "points" else rr.Arrows3D
            self._stream.log(path, shape.from_fields(colors=colours, radii=[radius]), static=True)
        self._send(path, at, _shapes(kind, rows), count)

    def _clear(self, steps: list[Step], times: Times, every: int) -> None:
        """Takes each stage's geometry away when the next stage comes, on the stage timeline alone; and on all three
        at the first step that lacks the stage."""
        within: dict[str, list[int]] = {}
        absent: dict[str, list[int]] = {}
        for row, step in enumerate(steps):
            names = tuple(s.name for s in step.stages)
            drawn = names if step.index % every == 0 else ()
            place = int(times.stage[row])
            for name in self._last:
                if name not in drawn:
                    absent.setdefault(name, []).append(row)
                elif name == self._last_stage and name != names[0]:
                    within.setdefault(name, []).append(place)
            for i, (name, after) in enumerate(pairwise(drawn)):
                if name != after:
                    within.setdefault(name, []).append(place + i + 1)
            self._last, self._last_stage = drawn, names[-1] if names else ""
        for name, places in within.items():
            for path, kind in self._paths.get(name, ()):
                columns = partition(_shapes(kind, np.empty((0, 3))), 0, len(places))
                index = [rr.TimeColumn("stage", sequence=places)]
                rr.send_columns(path, index, columns, recording=self._stream, strict=True)
        for name, rows in absent.items():
            for path, kind in self._paths.get(name, ()):
                self._send(path, times.pick(np.array(rows)), _shapes(kind, np.empty((0, 3))), 0)

    def _sphere(self, path: str, radius: float) -> None:
        sphere = rr.Ellipsoids3D(
            centers=[[0, 0, 0]], half_sizes=[[radius] * 3], fill_mode="MajorWireframe",
            colors=[(70, 70, 78)], line_radii=[0.003 * radius],
        )  # fmt: skip
        self._stream.log(path, sphere, static=True)

    # --- the rest ----------------------------------------------------------------------------------------------------

    def _lane(self, name: str, at: Times, states: list[str]) -> None:
        """A lane of states, written where they change."""
        changed = [i for i, s in enumerate(states) if s != (states[i - 1] if i else self._states.get(name))]
        if not changed:
            return
        self._states[name] = states[-1]
        path = schema.lane(name)
        if name != "stage" and path not in self._styled:
            self._styled.add(path)
            values, colours = zip(*schema.HEALTH.items(), strict=True)
            self._stream.log(path, rr.StateConfiguration(values=values, colors=colours), static=True)
        self._send(path, at.pick(np.array(changed)), rr.StateChange.columns(state=[states[i] for i in changed]), 1)

    def _colour(self, sensor: str) -> schema.Colour:
        return schema.sensor_colour(self._layout.place(sensor))[1]

    def _send(self, path: str, at: Times, columns: rr.ComponentColumnList, count: int | np.ndarray) -> None:
        """Columns of `count` instances a row."""
        lengths = np.broadcast_to(np.asarray(count), (len(at),))
        rr.send_columns(path, at.columns(), columns.partition(lengths), recording=self._stream, strict=True)


def xyzw(q: Array) -> Array:
    """Our quaternions (w first) in Rerun's order; nothing else in the project turns one into the other."""
    return q[..., [1, 2, 3, 0]].astype(np.float32)


def _shapes(kind: str, rows: Array) -> rr.ComponentColumnList:
    rows = rows.astype(np.float32)
    return rr.Points3D.columns(positions=rows) if kind == "points" else rr.Arrows3D.columns(vectors=rows)


def _shown(unit: str) -> tuple[str, float]:
    """The unit in which a quantity is drawn, and the factor to it: angles in degrees."""
    return ("deg", 180 / np.pi) if unit == "rad" else (unit, 1.0)


def _health(step: Step, sensor: str) -> str:
    """What became of a sensor's reading in this step: a key of `schema.HEALTH`, or the fault's own name."""
    tick = step.tick
    if sensor in tick.faults:
        return f"{tick.faults[sensor]}, {'rejected' if sensor in tick.stand_ins else 'used'}"
    for stage in step.stages:
        innovation = getattr(stage, "innovation", None)
        if innovation is not None and sensor in innovation.space.parts:
            return "used" if innovation.used[list(innovation.space.parts).index(sensor)] else "gated"
    return "used" if sensor in tick.measurements or sensor in tick.raw else "absent"
