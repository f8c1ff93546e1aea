"""What a comparison costs against copying its recordings' bytes: `python tests/bench/compare.py [A.rrd B.rrd]`.

Prints wall time and the highest memory of both, each in a process of its own. Without files it first makes two runs of
some 200 MB. Never a test: machines differ.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import rerun as rr
from rerun.chunk import RrdReader

from viz_estim.cli import main
from viz_estim.compare import compare

_DURATION = 290  # s of imu-ukf at 104 Hz


def copied(out: Path, files: list[Path]) -> None:
    """The files' chunks through Rerun's reader and writer, and nothing else."""
    with rr.RecordingStream("viz_estim bench") as stream:
        stream.save(out)
        for file in files:
            rr.send_chunks(RrdReader(file).stream(), recording=stream)
        stream.flush()
        stream.disconnect()


def measured(what: str, out: Path, files: list[Path]) -> None:
    began = time.perf_counter()
    if what == "copy":
        copied(out, files)
    else:
        compare(files, out, 1e-9)
    took = time.perf_counter() - began
    unit = 1e6 if sys.platform == "darwin" else 1e3
    highest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    print(f"{what:8} {took:6.2f} s  {highest:6.0f} MB  writes {out.stat().st_size / 1e6:.0f} MB", flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] in (["copy"], ["compare"]):
        measured(sys.argv[1], Path(sys.argv[2]), [Path(file) for file in sys.argv[3:]])
    else:
        with tempfile.TemporaryDirectory() as folder:
            given = sys.argv[1:]
            if not given:
                given = [f"{folder}/a.rrd", f"{folder}/b.rrd"]
                for file, noise in zip(given, ("0.1", "0.2"), strict=True):
                    settings = ["--set", f"data.duration={_DURATION}", "--set", f"gyro_noise={noise}"]
                    main(["run", "imu-ukf", "--seed", "3", *settings, "--out", file])
            print(f"{len(given)} recordings of {', '.join(f'{Path(f).stat().st_size / 1e6:.0f}' for f in given)} MB")
            for what in ("copy", "compare") * 2:
                command = [sys.executable, __file__, what, f"{folder}/{what}.rrd", *given]
                subprocess.run(command, check=True)
                Path(f"{folder}/{what}.rrd").unlink()
