"""What a camera saw: the picture where the camera looked, and the canvas that all pictures made so far."""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from viz_estim.core import quaternions
from viz_estim.core.mosaic import Paint
from viz_estim.core.panoramas import HEIGHT, Picture, place_on, rays, unrolled
from viz_estim.core.quaternions import Array
from viz_estim.core.scenery import Camera
from viz_estim.recording import schema
from viz_estim.recording.batch import Batch, StageRows
from viz_estim.recording.bodies import xyzw
from viz_estim.recording.columns import Times, send, send_static
from viz_estim.recording.layout import Layout

CAMERA = f"{schema.ATTITUDE}/camera"
CANVAS = "/canvas"
PANORAMA = "/panorama"

_EDGE = 24  # dots on each side of a frame
_QUALITY = 70  # of JPEG
_TYPE = "image/jpeg"
_BACKGROUND = [13, 14, 16]


class Pictures:
    """Draws each picture painted: in the frustum that turns in the attitude's scene, and on the canvas, with a dotted
    frame where it lay, and where it should have lain.

    All of it stands until the next picture. every: at most one picture in N steps is drawn.
    """

    def __init__(self, stream: rr.RecordingStream, layout: Layout, every: int) -> None:
        self._stream, self._layout, self._every = stream, layout, every
        self._drawn = -1  # the last N steps of which one was drawn
        if layout.camera is None:
            return
        camera = layout.camera
        rows, columns = camera.pictures.shape[1:3]
        focal = 0.5 * np.array([columns, rows]) / np.tan(0.5 * np.array(camera.field_of_view))
        frustum = rr.Pinhole(
            focal_length=focal, width=columns, height=rows, camera_xyz=rr.ViewCoordinates.FLU,
            image_plane_distance=1.0, color=schema.ESTIMATE,
        )  # fmt: skip
        send_static(stream, CAMERA, frustum)
        for path in (f"{CAMERA}/picture", f"{CANVAS}/mosaic"):
            send_static(stream, path, rr.EncodedImage.from_fields(media_type=_TYPE))
        for path in (CANVAS, PANORAMA) if camera.panorama is not None else (CANVAS,):
            height = HEIGHT if path == CANVAS or camera.panorama is None else len(camera.panorama)
            self._draw_degrees(path, height)
        if camera.panorama is not None:
            send_static(stream, f"{PANORAMA}/true", rr.EncodedImage(contents=_jpeg(camera.panorama), media_type=_TYPE))
        ends = -1 + 2 * np.arange(_EDGE) / _EDGE
        side = np.ones(_EDGE)
        across, down = np.concatenate([ends, side, -ends, -side]), np.concatenate([-side, ends, side, -ends])
        self._frame = rays(across, down, camera.field_of_view)
        for name, colour in (("estimate", schema.ESTIMATE), ("truth", schema.TRUTH)):
            style = rr.Points2D.from_fields(colors=[colour], radii=[-1.5], draw_order=2.0)
            send_static(stream, f"{CANVAS}/frame/{name}", style)

    def add(self, batch: Batch) -> None:
        for rows in batch.stages:
            if self._layout.camera and isinstance(rows.stages[0], Paint):
                turns = rows.at.step // self._every
                kept = np.flatnonzero(np.diff(turns, prepend=self._drawn) > 0)
                self._drawn = turns[-1]
                if len(kept):
                    self._draw(self._layout.camera, rows, kept, batch.truth[rows.rows[kept]])

    def _draw(self, camera: Camera, rows: StageRows, kept: np.ndarray, truth: Array) -> None:
        at = rows.at.pick(kept)
        q = quaternions.from_euler(rows.array("angles")[kept])
        numbers = rows.array("picture")[kept, 0].astype(int)
        self._send(CAMERA, at, rr.Transform3D.columns(quaternion=xyzw(q)))
        self._send_images(f"{CAMERA}/picture", at, [camera.pictures[i] for i in numbers])
        tiles = rows.objects("belief.tiles")
        self._send_images(f"{CANVAS}/mosaic", at, [unrolled(tiles[i])[0] for i in kept])
        self._draw_frames("estimate", at, q)
        if self._layout.attitude in self._layout.true_parts:
            self._draw_frames("truth", at, truth[:, self._layout.space.at[self._layout.attitude]])

    def _draw_frames(self, name: str, at: Times, q: Array) -> None:
        """The picture's border on the canvas, at attitudes (M, 4); nothing where one is NaN."""
        known = np.isfinite(q).all(1)
        border = self._frame @ np.swapaxes(quaternions.to_matrix(q[known]), 1, 2)
        places = place_on(HEIGHT, border)[..., ::-1].reshape(-1, 2) + 0.5
        columns = rr.Points2D.columns(positions=places).partition(np.where(known, len(self._frame), 0))
        self._send(f"{CANVAS}/frame/{name}", at, columns)

    def _draw_degrees(self, path: str, height: int) -> None:
        """Lines and numbers at azimuths and elevations."""
        degree = height / 180
        azimuths, elevations = np.arange(-150, 180, 30), np.arange(-60, 90, 30)
        strips = [[[(180 - a) * degree, 0], [(180 - a) * degree, height]] for a in azimuths]
        strips += [[[0, (90 - e) * degree], [2 * height, (90 - e) * degree]] for e in elevations]
        lines = rr.LineStrips2D(strips, colors=[(*schema.BAND, 70)], radii=[-0.5], draw_order=1.0)
        send_static(self._stream, f"{path}/degrees", lines)
        marks = [[(180 - a) * degree, 0.9 * height] for a in azimuths if a % 60 == 0]
        marks += [[0.08 * height, (90 - e) * degree] for e in elevations]
        labels = [f"{a}°" for a in azimuths if a % 60 == 0] + [f"{e}°" for e in elevations]
        points = rr.Points2D(marks, labels=labels, colors=[schema.BAND], radii=[-1], show_labels=True, draw_order=1.0)
        send_static(self._stream, f"{path}/degrees/numbers", points)

    def _send_images(self, path: str, at: Times, images: list[Picture]) -> None:
        self._send(path, at, rr.EncodedImage.columns(blob=[_jpeg(image) for image in images]))

    def _send(self, path: str, at: Times, columns: rr.ComponentColumnList) -> None:
        send(self._stream, path, at, columns)


def views(layout: Layout) -> list[rrb.View]:
    """The canvas, the last picture alone, and the true panorama where it is known."""
    if layout.camera is None:
        return []
    found = [_sphere(CANVAS, "Mosaic [deg]", HEIGHT)]
    if layout.camera.panorama is not None:
        found.append(_sphere(PANORAMA, "True world [deg]", len(layout.camera.panorama)))
    return [*found, rrb.Spatial2DView(origin=CAMERA, name="Picture", background=_BACKGROUND)]


def _sphere(origin: str, name: str, height: int) -> rrb.View:
    """An unrolled sphere, whole."""
    room = 0.02 * height
    bounds = rrb.VisualBounds2D(x_range=[-room, 2 * height + room], y_range=[-room, height + room])
    return rrb.Spatial2DView(origin=origin, name=name, visual_bounds=bounds, background=_BACKGROUND)


def _jpeg(image: Picture) -> bytes:
    encoded = rr.Image(np.ascontiguousarray(image)).compress(jpeg_quality=_QUALITY)
    assert isinstance(encoded, rr.EncodedImage)
    assert encoded.blob is not None
    content: bytes = encoded.blob.as_arrow_array().values.to_numpy().tobytes()
    return content
