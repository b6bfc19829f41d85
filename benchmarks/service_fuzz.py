"""Decodes a million damaged images with the service's image decoder, without a server.

Each image is a JPEG or PNG with flipped bits, overwritten, cut or repeated parts, wrong numbers in
its header, or another file after it. The decoder must return pixels or raise ImageError. Any other
result is a fault; the seed, part and number in its message reproduce it. Memory is measured after a
tenth of the images and at the end, and must grow by less than 1 % between the two measurements.

    python benchmarks/service_fuzz.py [--count 1000000] [--seed 0] [--workers N]
"""

import os
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import cv2
import numpy as np
import simplejpeg

from benchmarks.claims.outcome import conclude, run_command
from mtlnet.inference.image_decoding.decode import crop_and_resize, decode_whole, read_header
from mtlnet.inference.image_decoding.errors import ImageError
from tests.serve.attacks.conftest import resident_mb
from trackfeatures.camera import CameraParameters

MAX_GROWTH = 0.01
VIEW = CameraParameters()


def seeds() -> list[bytes]:
    """Return undamaged JPEG and PNG files, which are then mutated. They are small, so that
    mutations often hit the headers."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (21, 28, 3), np.uint8)
    progressive = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    restarts = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_RST_INTERVAL, 1])[1].tobytes()
    pngs = [cv2.imencode(".png", found)[1].tobytes() for found in (image, image[:, :, 0])]
    return [simplejpeg.encode_jpeg(image, 90), progressive, restarts, *pngs]


def mutate(rng: np.random.Generator, whole: list[bytes]) -> bytes:
    """Return a random image of `whole` with one to four random changes."""
    body = bytearray(whole[rng.integers(len(whole))])
    for _ in range(rng.integers(1, 5)):
        at, size = int(rng.integers(len(body))), int(rng.integers(1, 40))
        match rng.integers(7):
            case 0:
                body[at] ^= 1 << int(rng.integers(8))
            case 1:  # headers lie in the first hundred bytes
                body[min(at, int(rng.integers(100)), len(body) - 1)] = int(rng.integers(256))
            case 2:
                body[at : at + size] = rng.bytes(size)
            case 3:
                body[at : at + size] = body[at : at + size] * 2
            case 4:
                del body[at + 1 :]
            case 5:
                body += whole[rng.integers(len(whole))]
            case 6:  # extreme values of two bytes, which may belong to a size
                body[at : at + 2] = (b"\xff\xff", b"\x00\x00", b"\x7f\xff")[rng.integers(3)]
    return bytes(body)


def run_part(seed: int, part: int, count: int) -> tuple[int, int, float, list[str]]:
    """Decode `count` damaged images, which are determined by `seed` and `part`.

    Returns the number of images that gave pixels, the number of refused images, the growth of the
    memory as a share, and a message for each fault.
    """
    whole, accepted, refused, faults = seeds(), 0, 0, []
    early = 0.0
    for number in range(count):
        rng = np.random.default_rng([seed, part, number])
        body = mutate(rng, whole)
        try:
            image = crop_and_resize(decode_whole(body, read_header(body)), VIEW)
            accepted += 1
            if image.shape != (210, 280, 3):
                faults.append(f"part {part}, number {number}: shape {image.shape}")
        except ImageError:
            refused += 1
        except Exception as error:  # noqa: BLE001  # the benchmark looks for any exception
            faults.append(f"part {part}, number {number}: {error!r}")
        if number == count // 10:
            early = resident_mb()
    return accepted, refused, resident_mb() / early - 1.0, faults


def main(count: int = 1_000_000, seed: int = 0, workers: int = os.cpu_count() or 1) -> None:
    share = count // workers
    with ProcessPoolExecutor(workers) as pool:  # a crash of a worker raises BrokenProcessPool
        results = list(
            pool.map(run_part, [seed] * workers, range(workers), [share] * workers, chunksize=1)
        )
    growth = max(result[2] for result in results)
    faults = [fault for result in results for fault in result[3]]
    figures = {
        "gave_pixels": sum(result[0] for result in results),
        "refused": sum(result[1] for result in results),
        "faults": faults[:20],
        "memory_growth": round(growth, 4),
        "claim_growth_below": MAX_GROWTH,
    }
    conclude(figures, None, not faults and growth < MAX_GROWTH)


if __name__ == "__main__":
    run_command(main)
