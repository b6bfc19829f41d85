"""Speed of `mtlnet predict film.mp4 --out drawn.mp4` for a film of 1280 x 720 px (H.264).

The time includes decoding, inference, drawing and encoding on two cores. The result also has the
processor time of each of these parts, measured separately. FFmpeg generates the film: noise over
moving colours, 6 Mbit/s.

    python benchmarks/film.py [--seconds 20] [--model RUN] [--json FILE]
    claim: at least 45 pictures per second
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import perf_counter, process_time

sys.path.insert(0, str(Path(__file__).parents[1]))

import cv2

from benchmarks.claims.outcome import conclude, not_measured, run_command
from mtlnet.inference.engine import load_engine
from mtlnet.inference.model_card import resolve_run
from mtlnet.inference.prediction import decode_outputs
from mtlnet.predict.run import predict_files
from mtlnet.predict.writers import FilmWriter, draw_prediction
from mtlnet.sources.films import Film
from mtlnet.sources.pictures import Picture, fit
from mtlnet.sources.read import SourceImage

CLAIM_FPS = 45.0
CORES = 2
KEPT = 60  # number of pictures with which the parts after decoding are timed


def make_film(path: Path, seconds: float) -> bool:
    """Write an H.264 film of `seconds` s to `path`; return False if imageio-ffmpeg is missing."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError:
        return False
    source = f"testsrc2=size=1280x720:rate=30:duration={seconds}"
    options = ["-vf", "noise=alls=6:allf=t", "-c:v", "libx264", "-preset", "fast", "-b:v", "6M"]
    command = [get_ffmpeg_exe(), "-v", "error", "-f", "lavfi", "-i", source, *options]
    subprocess.run([*command, "-pix_fmt", "yuv420p", str(path)], check=True)
    return True


def cpu_ms(work: Callable[[], int]) -> float:
    """Return the processor time of `work` in ms per picture. `work` processes some pictures and
    returns their number."""
    begin = process_time()
    count = work()
    return 1e3 * (process_time() - begin) / count


def parts(film: Path, model: str, folder: Path) -> dict[str, float]:
    """Return the processor time in ms per picture of each part of the work: decode, scale, network,
    draw and encode."""
    engine = load_engine(resolve_run(model))
    camera = engine.card.camera
    pictures: list[Picture] = []

    def decode() -> int:
        count = 0
        for picture in Film(film).pictures():
            count += 1
            if len(pictures) < KEPT:
                pictures.append(picture)
        return count

    found = {"decode": cpu_ms(decode)}
    images = [fit(picture, camera, None) for picture in pictures]
    found["scale"] = cpu_ms(lambda: len([fit(picture, camera, None) for picture in pictures]))
    answers = [decode_outputs(engine(image)) for image in images]
    found["network"] = cpu_ms(lambda: len([decode_outputs(engine(image)) for image in images]))
    items = [SourceImage(str(film), number, image) for number, image in enumerate(images)]
    both = list(zip(items, answers, strict=True))
    found["draw"] = cpu_ms(lambda: len([draw_prediction(*pair, camera) for pair in both]))

    def encode() -> int:
        with FilmWriter(folder / "part.mp4", camera, 30.0) as writer:
            for pair in both:
                writer.write(*pair)
        return len(both)

    found["encode"] = cpu_ms(encode) - found["draw"]
    return found


def main(seconds: float = 20.0, model: str = "default", json: Path | None = None) -> None:
    cores = sorted(os.sched_getaffinity(0))[:CORES]
    os.sched_setaffinity(0, cores)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        film = folder / "film.mp4"
        if not make_film(film, seconds):
            not_measured("install imageio-ffmpeg, which makes the film")
        cv2.setNumThreads(CORES)
        by_part = {part: round(ms, 1) for part, ms in parts(film, model, folder).items()}
        engine = load_engine(resolve_run(model))
        begin, used = perf_counter(), process_time()
        count = len(predict_files(engine, [str(film)], [folder / "drawn.mp4"]))
        elapsed, used = perf_counter() - begin, process_time() - used
    fps = count / elapsed
    figures = {
        "pictures": count,
        "cores": len(cores),
        "precision": engine.precision,
        "cpu_ms_by_part": by_part,
        "cpu_ms_per_picture": round(1e3 * used / count, 1),
        "pictures_per_second": round(fps, 1),
        "claim_pictures_per_second": CLAIM_FPS,
    }
    conclude(figures, json, fps >= CLAIM_FPS)


if __name__ == "__main__":
    run_command(main)
