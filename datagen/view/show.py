"""Shows a round: in Rerun's viewer, as a Rerun file, over the web, or as an HTML page."""

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
from runtime.files import atomic_write, check_folder, require_other_file, utf8_path
from trackfeatures.errors import UserError

OnShown = Callable[[str], None]
"""Called with the place where the round is shown: a path, a URL, or a window."""


@dataclass(frozen=True, slots=True)
class ShowConfig:
    """Options of `datagen view`; the command declares their defaults."""

    html: Path | None
    save: Path | None
    web: bool
    port: int

    def validate(self, recorded: Path) -> None:
        """Raise UserError for impossible options; called before the round `recorded` is read."""
        if sum((self.html is not None, self.save is not None, self.web)) > 1:
            raise UserError("--html, --save and --web exclude each other; give one of them")
        for option, path in (("--html", self.html), ("--save", self.save)):
            if path is not None:
                check_folder(path)
                require_other_file(path, [recorded], option)
        if self.html is not None:
            return
        _require_rerun()
        os.environ.setdefault("RUST_LOG", "off")  # errors are reported below, in one line
        if self.web:
            _require_free(self.port)
            _require_free(self.port + 1)
        elif self.save is None:
            _require_screen()


def show(contents: Contents, config: ShowConfig, on_shown: OnShown) -> None:
    """Show a round as the options in `config` require, and call `on_shown` with the path, the URL
    or the name of the window where it is shown.

    Raises UserError or OSError, and KeyboardInterrupt when the user stops the web viewer.
    """
    if config.html is not None:
        from datagen.view.html_page import page

        atomic_write(config.html, page(contents))
        on_shown(str(config.html))
    elif config.save is not None:
        save(contents, config.save)
        on_shown(str(config.save))
    elif config.web:
        _serve(contents, config.port, on_shown)
    else:
        _open_window(contents)
        on_shown("Rerun's window")


def save(contents: Contents, path: Path) -> None:
    """Write a Rerun file (.rrd), atomically."""
    import rerun as rr

    from datagen.view.rerun import APPLICATION, log

    partial = path.with_name(path.name + ".partial")
    try:
        recording = rr.RecordingStream(APPLICATION, recording_id=contents.header.id)
        with utf8_path(partial) as plain:
            recording.save(plain)
            log(contents, recording)
            recording.flush()
            recording.disconnect()
            _require_all_images(plain, len(contents.steps))
        partial.replace(path)
    except (RuntimeError, ValueError) as error:
        raise UserError(
            f"{path} could not be written completely ({error}); is the disk full? Free some space "
            "and run the same command again"
        ) from error
    finally:
        partial.unlink(missing_ok=True)


def _require_all_images(path: Path, frames: int) -> None:
    """Raise ValueError unless the Rerun file at `path` has all `frames` images. The check is needed
    because Rerun writes in the background and does not report a failed write."""
    from rerun.chunk import RrdReader

    from datagen.view.rerun import IMAGE

    chunks = [chunk for chunk in RrdReader(path).stream() if chunk.entity_path == f"/{IMAGE}"]
    if (written := sum(chunk.num_rows for chunk in chunks)) != frames:
        raise ValueError(f"{written} of {frames} images arrived")


def _open_window(contents: Contents) -> None:
    """Open Rerun's window, which stays open after this process ends."""
    import rerun as rr

    from datagen.view.rerun import APPLICATION, log

    recording = rr.RecordingStream(APPLICATION)
    recording.spawn()
    log(contents, recording)
    recording.flush()


def _serve(contents: Contents, port: int, on_shown: OnShown) -> None:
    import rerun as rr

    from datagen.view.rerun import APPLICATION, log

    recording = rr.RecordingStream(APPLICATION)
    data = recording.serve_grpc(grpc_port=port + 1)
    rr.serve_web_viewer(web_port=port, open_browser=False, connect_to=data)
    log(contents, recording)
    recording.flush()
    on_shown(f"http://localhost:{port}/?url={quote(data, safe=':/')}")
    while True:
        time.sleep(1)


def _require_rerun() -> None:
    if find_spec("rerun") is None:
        raise UserError(
            "Rerun is not installed; run `pip install 'driverview[view]'`, or write a page "
            "with --html FILE"
        )


def _require_screen() -> None:
    """Raise UserError if there is no display; the viewer itself would end without a message."""
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
