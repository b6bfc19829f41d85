"""Where compiled machine code is kept on disk: a folder for each state of a package's sources.

numba's own cache only sees the file of the outermost function: after a change in a function that it
calls from another file, the old machine code would go on being used.
"""

import hashlib
import os
import shutil
import tempfile
import time
from pathlib import Path

UNUSED_DAYS = 30.0  # after which the code of other sources is deleted


def code_folder(name: str, package: Path) -> Path:
    """A folder that can be written to, for the machine code of all of a package's sources.

    Below `$NUMBA_CACHE_DIR` or the user's cache folder, else a temporary one; named after `name`
    and a hash of the sources. What was not used for a month goes.
    """
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        digest.update(source.read_bytes())
    found = f"{name}-{digest.hexdigest()[:16]}"
    home = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    for parent in (Path(home) if home else Path.home() / ".cache", Path(tempfile.gettempdir())):
        folder = parent / found
        try:
            folder.mkdir(parents=True, exist_ok=True)
            os.utime(folder)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            _forget_unused(parent, name)
            return folder
    return Path(tempfile.mkdtemp(prefix=found))


def _forget_unused(parent: Path, name: str) -> None:
    since = time.time() - UNUSED_DAYS * 86_400
    for folder in parent.glob(f"{name}-{'[0-9a-f]' * 16}"):
        try:
            if folder.stat().st_mtime < since:
                shutil.rmtree(folder, ignore_errors=True)
        except OSError:  # another process was quicker
            continue
