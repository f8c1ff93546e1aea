"""A camera beside an IMU: the data, and the mosaic that its pictures make of the world under an attitude filter."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from viz_estim.core.beliefs import Gaussian
from viz_estim.core.mosaic import Mosaic, Painter
from viz_estim.core.panoramas import Picture, blank, similarity
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Step, Tick
from viz_estim.core.scenery import Box, Camera
from viz_estim.core.spaces import SO3, Product
from viz_estim.core.stages import Stage
from viz_estim.errors import BadInput
from viz_estim.scenarios import camera_files, camera_simulation, imu, imu_files
from viz_estim.scenarios.imu_data import ImuData

By = Literal["imu-gyro", "imu-ukf-gyro", "truth"]

_BODY = Box((0.4, 0.25, 0.12))
_CAPTURE_STD = 0.003  # rad: of motion capture


@dataclass(frozen=True)
class CameraData:
    """An IMU's data, and pictures (K, M, N, 3) at stamps (K,) s on its time; panorama: what they show, if known.

    files: what all of it was read from.
    """

    imu: ImuData
    stamps: Array
    pictures: Picture
    panorama: Picture | None
    files: tuple[Path, ...]


def camera(
    source: list[Path] | None,
    rng: np.random.Generator,
    *,
    calibration: Path | None = None,
    along: str | None = None,
    duration: float = 30.0,
    still: float = 3.0,
    freeze: float = 1.0,
    noise_scale: float = 1.0,
    rate_hz: float = 10.0,
    width: int = 160,
) -> CameraData:
    """An IMU's log and a camera's pictures from files; or pictures of a town drawn here, taken along motion capture.

    along: an IMU's file or folder, whose motion capture (found beside it) the camera follows; without it the IMU is
    simulated too, by `duration`, `still`, `freeze` and `noise_scale`. A picture has `width` columns and ¾ as many rows.
    """
    if source is not None:
        found = camera_files.find(source)
        data = imu.imu([file for file in (found.imu, found.truth) if file], rng, calibration=calibration)
        stamps, pictures = camera_files.load_pictures(found.camera)
        panorama = camera_files.load_panorama(found.panorama) if found.panorama else None
        more = [file for file in (found.camera, found.panorama) if file]
        return CameraData(data, stamps - data.log.stamps[0], pictures, panorama, (*data.log.files, *more))
    if not 0 < rate_hz <= 100 or not 8 <= width <= 2000:
        raise BadInput(f"a camera needs a rate_hz up to 100 and a width of 8 to 2000: got {rate_hz:g} and {width}")
    if along is not None:
        data = imu.imu([Path(along)], rng, calibration=calibration)
        if not np.isfinite(data.truth).any():
            raise BadInput(
                f"{along}: has no motion capture beside it; pictures can be taken along a known attitude only"
            )
    else:
        data = imu.imu(
            None, rng, calibration=calibration, duration=duration, still=still, freeze=freeze, noise_scale=noise_scale
        )
    panorama = camera_simulation.draw_panorama(rng)
    shape = max(1, round(0.75 * width)), width
    stamps, pictures = camera_simulation.take_pictures(panorama, data.time, data.truth, rate_hz=rate_hz, shape=shape)
    return CameraData(data, stamps, pictures, panorama, data.log.files)


def save(data: CameraData, folder: Path) -> list[Path]:
    """Writes simulated data in the course's format, the panorama beside it. An IMU's files that were followed stay
    where they are: the pictures take their number."""
    log = data.imu.log
    number = (camera_files.number_of(log.files[0]) if log.files else None) or "1"
    assert data.panorama is not None
    made = [] if log.files else imu_files.save_course(folder, 1, log)
    return made + camera_files.save(folder, number, log.stamps[0] + data.stamps, data.pictures, data.panorama)


def mosaic(
    data: CameraData,
    *,
    by: By = "imu-ukf-gyro",
    initial: imu.Initial | None = None,
    frozen: imu.Frozen = "ignore",
    horizontal_fov_deg: float = camera_simulation.FIELD_OF_VIEW_DEG[0],
    vertical_fov_deg: float = camera_simulation.FIELD_OF_VIEW_DEG[1],
) -> Scenario:
    """Pictures on a sphere by the estimated attitude, unrolled: a world as sharp as the attitude is right.

    by: the filter that says where each picture lies, or motion capture itself. initial: the filter's own; without it,
    it starts at the truth where there is one. frozen: the UKF's own. The fields of view are the camera's, which looks
    along the body's x axis.
    """
    if not (1 <= horizontal_fov_deg <= 170 and 1 <= vertical_fov_deg <= 170):
        raise BadInput(f"fields of view are between 1° and 170°: got {horizontal_fov_deg:g} and {vertical_fov_deg:g}")
    known = np.asarray(np.isfinite(data.imu.truth).all(1))
    start = initial or ("truth" if known.any() else "accel")
    if by == "truth":
        inner = _followed(data.imu, known)
    elif by == "imu-gyro":
        inner = imu.imu_gyro(data.imu, initial=start)
    else:
        inner = imu.imu_ukf_gyro(data.imu, initial=start, frozen=frozen)
    fov = float(np.radians(horizontal_fov_deg)), float(np.radians(vertical_fov_deg))
    seen = Camera(data.pictures, fov, data.panorama)
    beliefs = {k: Mosaic(belief.space, belief.mean, belief.cov, blank()) for k, belief in inner.beliefs.items()}
    usable = known & np.concatenate([known[:1], known[:-1]]) if by == "truth" else np.ones(len(known), bool)
    ticks = _with_pictures(inner.ticks, data, usable)
    if not any("picture" in tick.measurements for tick in ticks):
        raise BadInput("no picture was taken while the attitude is known: do the camera's and the IMU's stamps agree?")

    def figures(last: Step) -> dict[str, float]:
        painted = last.stages[-1].belief if last.stages else None
        return {} if painted is None or data.panorama is None else similarity(painted.tiles, data.panorama)

    return Scenario(
        Painter(inner.estimator, seen), beliefs, ticks, inner.truth, {"body": _BODY, "camera": seen},
        _notes(data, by, start), figures=figures,
    )  # fmt: skip


@dataclass(frozen=True)
class _Follower:
    """Takes over what motion capture says, and stands still where that is lost."""

    pure = True

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        q = tick.measurements.get("attitude", belief.mean)
        yield Stage("follow", Gaussian(belief.space, q, belief.cov))


def _followed(data: ImuData, known: NDArray[np.bool_]) -> Scenario:
    """Motion capture as an estimator of its own; there is no truth left to compare it with."""
    if not known.any():
        raise BadInput("by=truth needs motion capture, and this data has none: use by=imu-ukf-gyro")
    first = Gaussian(Product(attitude=SO3()), data.truth[np.argmax(known)], _CAPTURE_STD**2 * np.eye(3))
    ticks = [
        Tick(float(time), float(dt), None, {"attitude": q} if there else {})
        for time, dt, q, there in zip(data.time, np.diff(data.time, prepend=0.0), data.truth, known, strict=True)
    ]
    return Scenario(_Follower(), {0: first}, ticks)


def _with_pictures(ticks: Sequence[Tick], data: CameraData, usable: NDArray[np.bool_]) -> list[Tick]:
    """The ticks, each with the last picture taken since the one before; those before the first or after the last IMU
    sample are left out, and those at ticks that are not usable."""
    time = data.imu.time
    inside = np.flatnonzero((data.stamps >= time[0]) & (data.stamps <= time[-1]))
    out = list(ticks)
    for tick, number in zip(np.searchsorted(time, data.stamps[inside]), inside, strict=True):
        if usable[tick]:
            reading = np.array([number, data.stamps[number]])
            measurements = {**ticks[tick].measurements, "picture": reading}
            out[tick] = dataclasses.replace(ticks[tick], measurements=measurements)
    return out


def _notes(data: CameraData, by: By, start: str) -> str:
    ends = "" if data.panorama is None else " `psnr_db` is the similarity to the true panorama, over what was seen."
    turned = "" if by == "truth" or start == "truth" else " It starts with heading 0: the whole world may be turned."
    rows, columns = data.pictures.shape[1:3]
    return (
        f"Each picture is painted where **{by}** says that the camera looked; where several overlap, their weighted "
        "mean stands. A sharp house was seen at one place, a doubled one at two; a horizon in steps is a tilt. The "
        "dotted frame is the last picture's, amber by the estimate, white by the truth. `mismatch` is how ill a "
        f"picture fits what was there: it needs no truth.{ends}{turned} Compare `by=truth`, `by=imu-ukf-gyro` and "
        "`by=imu-gyro`.\n\n"
        f"**This data:** {len(data.pictures)} pictures of {columns}×{rows}; {data.imu.notes}"
    )
