"""`mtlnet predict film.mp4 --out drawn.mp4`: pictures a second of a film of 1280 x 720 (H.264).

Decoded, answered and drawn, on two cores; and where the CPU's time goes, each part by itself. The
film is noise over moving colours of 6 Mbit/s, made by the FFmpeg program.

    python benchmarks/film.py [--seconds 20] [--model RUN]
    claim: at least 45 pictures a second
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import perf_counter, process_time

sys.path.insert(0, str(Path(__file__).parents[1]))

import cv2

from benchmarks.material.outcome import exit_code, not_measured
from mtlnet.inference.engine import load_engine
from mtlnet.inference.model_card import resolve_run
from mtlnet.inference.prediction import decode_outputs
from mtlnet.predict.films import Film
from mtlnet.predict.pictures import Picture, fit
from mtlnet.predict.run import predict_files
from mtlnet.predict.sources import SourceImage
from mtlnet.predict.writers import FilmWriter, draw_prediction

CLAIM_FPS = 45.0
CORES = 2
KEPT = 60


def make_film(path: Path, seconds: float) -> bool:
    """Whether there is an FFmpeg program to make it."""
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
    """CPU time of `work` in ms for each of the pictures that it counts."""
    begin = process_time()
    count = work()
    return 1e3 * (process_time() - begin) / count


def parts(film: Path, model: str, folder: Path) -> dict[str, float]:
    """CPU time of each part, ms a picture."""
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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--model", default="default")
    given = parser.parse_args()
    cores = sorted(os.sched_getaffinity(0))[:CORES]
    os.sched_setaffinity(0, cores)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        film = folder / "film.mp4"
        if not make_film(film, given.seconds):
            return not_measured("install imageio-ffmpeg, which makes the film")
        cv2.setNumThreads(CORES)
        print("ms of CPU a picture: ", end="")
        print(", ".join(f"{k} {v:.1f}" for k, v in parts(film, given.model, folder).items()))
        engine = load_engine(resolve_run(given.model))
        begin, used = perf_counter(), process_time()
        count = len(predict_files(engine, [str(film)], [folder / "drawn.mp4"]))
        seconds, used = perf_counter() - begin, process_time() - used
    fps = count / seconds
    print(
        f"{count} pictures of 1280 x 720 on {len(cores)} cores: {1e3 * used / count:.1f} ms of CPU"
    )
    print(f"each, {fps:.1f} pictures a second (claim: {CLAIM_FPS:g})")
    return exit_code(fps >= CLAIM_FPS)


if __name__ == "__main__":
    raise SystemExit(main())
