"""Opening a round: in Rerun's viewer, in a file for it, over the web, or as a page of HTML."""

import os
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import quote

from datagen.view.contents import Contents
from runtime.files import atomic_write, check_folder
from trackfeatures.errors import UserError

Told = Callable[[str], None]
"""Hears where the round is shown."""


@dataclass(frozen=True, slots=True)
class Ways:
    """How to show a round; a window of Rerun where nothing is given."""

    html: Path | None = None
    save: Path | None = None
    web: bool = False
    port: int = 9090

    def require_sane(self) -> None:
        """Raise UserError where it cannot be done, before anything is read."""
        if sum((self.html is not None, self.save is not None, self.web)) > 1:
            raise UserError("--html, --save and --web are three ways to show it; give one of them")
        for path in (self.html, self.save):
            if path is not None:
                check_folder(path)
        if self.html is not None:
            return
        _require_rerun()
        os.environ.setdefault("RUST_LOG", "off")  # what goes wrong is said here, in one line
        if self.web:
            _require_free(self.port)
            _require_free(self.port + 1)
        elif self.save is None:
            _require_screen()


def show(contents: Contents, ways: Ways, told: Told) -> None:
    """Show a round. Raises UserError, OSError, or KeyboardInterrupt when a server is ended."""
    if ways.html is not None:
        from datagen.view.html_page import page

        atomic_write(ways.html, page(contents))
        told(str(ways.html))
    elif ways.save is not None:
        save(contents, ways.save)
        told(str(ways.save))
    elif ways.web:
        _serve(contents, ways.port, told)
    else:
        _open_window(contents)
        told("Rerun's window")


def save(contents: Contents, path: Path) -> None:
    """Write a .rrd file for Rerun, whole or not at all."""
    import rerun as rr

    from datagen.view.rerun import APPLICATION, log

    partial = path.with_name(path.name + ".partial")
    try:
        recording = rr.RecordingStream(APPLICATION, recording_id=contents.header.id)
        recording.save(partial)
        log(contents, recording)
        recording.flush()
        recording.disconnect()
        _require_whole(partial, len(contents.steps))
        partial.replace(path)
    except (RuntimeError, ValueError) as error:
        raise UserError(
            f"{path} could not be written whole ({error}); is the disk full? Free some space and "
            "run the same command again"
        ) from error
    finally:
        partial.unlink(missing_ok=True)


def _require_whole(path: Path, frames: int) -> None:
    """Raise ValueError unless all images have arrived: Rerun writes in the background."""
    from rerun.chunk import RrdReader

    from datagen.view.rerun import IMAGE

    chunks = [chunk for chunk in RrdReader(path).stream() if chunk.entity_path == f"/{IMAGE}"]
    if (written := sum(chunk.num_rows for chunk in chunks)) != frames:
        raise ValueError(f"{written} of {frames} images arrived")


def _open_window(contents: Contents) -> None:
    """The window stays when this process ends."""
    import rerun as rr

    from datagen.view.rerun import APPLICATION, log

    recording = rr.RecordingStream(APPLICATION)
    recording.spawn()
    log(contents, recording)
    recording.flush()


def _serve(contents: Contents, port: int, told: Told) -> None:
    import rerun as rr

    from datagen.view.rerun import APPLICATION, log

    recording = rr.RecordingStream(APPLICATION)
    data = recording.serve_grpc(grpc_port=port + 1)
    rr.serve_web_viewer(web_port=port, open_browser=False, connect_to=data)
    log(contents, recording)
    recording.flush()
    told(f"http://localhost:{port}/?url={quote(data, safe=':/')}")
    while True:
        time.sleep(1)


def _require_rerun() -> None:
    if find_spec("rerun") is None:
        raise UserError(
            "Rerun is not installed; run `pip install 'driverview[view]'`, or make a page that "
            "needs nothing with --html FILE"
        )


def _require_screen() -> None:
    """Without one the viewer would end without a word."""
    if sys.platform == "linux" and not any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY"))):
        raise UserError(
            "there is no screen to open a window on; give --web, --save FILE.rrd or --html FILE"
        )


def _require_free(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", port))
        except (OSError, OverflowError) as error:
            raise UserError(f"port {port} cannot be used ({error}); give another --port") from error
