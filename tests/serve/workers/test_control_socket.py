"""Commands over the control socket: the messages for the user after a failure."""

import asyncio
import os
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from serve.workers import control_socket as module
from serve.workers.control_socket import listen_for_commands, send_command
from trackfeatures.errors import UserError

PORT = 8000


@pytest.fixture
def short_path() -> Iterator[Path]:
    """A folder with a short path: the path of a socket may have at most 107 bytes."""
    with TemporaryDirectory(prefix="dv") as folder:
        yield Path(folder)


@pytest.fixture(autouse=True)
def socket_folder(short_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(short_path))


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (UserError("the weights are damaged"), "^the weights are damaged$"),
        (PermissionError(13, "Permission denied", "/model"), "Permission denied: '/model'"),
        (ValueError("bad card"), "the service failed .*bad card.*see its log"),
    ],
)
def test_the_reason_of_a_failed_command_is_told(error: Exception, said: str) -> None:
    async def fail(_model: str | None) -> str:
        raise error

    async def scenario() -> str:
        server = await listen_for_commands(PORT, {"reload": fail})
        assert server is not None
        async with server:
            return await asyncio.to_thread(send_command, PORT, "reload")

    with pytest.raises(UserError, match=said):
        asyncio.run(scenario())


def test_a_folder_of_another_user_is_not_trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    async def answer(_model: str | None) -> str:
        return "done"

    async def scenario() -> None:
        server = await listen_for_commands(PORT, {"reload": answer})
        assert server is not None
        async with server:
            assert await asyncio.to_thread(send_command, PORT, "reload") == "done"
            monkeypatch.setattr(os, "getuid", lambda: os.geteuid() + 1)
            with pytest.raises(UserError, match="no service of yours"):
                await asyncio.to_thread(send_command, PORT, "reload")

    asyncio.run(scenario())


def test_two_services_with_one_port_do_not_take_each_others_commands(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Two services can have the same port on different addresses."""

    async def answer(_model: str | None) -> str:
        return "first"

    async def scenario() -> None:
        server = await listen_for_commands(PORT, {"reload": answer})
        assert server is not None
        async with server:
            assert await listen_for_commands(PORT, {}) is None
            assert await asyncio.to_thread(send_command, PORT, "reload") == "first"
        again = await listen_for_commands(PORT, {"reload": answer})  # the file still exists
        assert again is not None
        again.close()

    asyncio.run(scenario())
    assert "another service on port 8000" in caplog.text


@pytest.mark.parametrize("has_login", [False, True])
def test_a_service_that_was_started_in_another_environment_is_found(
    short_path: Path, monkeypatch: pytest.MonkeyPatch, has_login: bool
) -> None:
    """systemd and cron set no XDG_RUNTIME_DIR, a login does. `has_login`: whether the service is
    started in a login and the command is not."""
    monkeypatch.setattr("tempfile.tempdir", str(short_path / "tmp"))
    monkeypatch.setattr(module, "RUNTIME_FOLDERS", short_path)
    login = short_path / str(os.getuid())
    for folder in (short_path / "tmp", login):
        folder.mkdir()

    def enter(runtime: Path | None) -> None:
        if runtime is None:
            monkeypatch.delenv("XDG_RUNTIME_DIR")
        else:
            monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))

    async def answer(_model: str | None) -> str:
        return "done"

    async def scenario() -> str:
        enter(login if has_login else None)
        server = await listen_for_commands(PORT, {"reload": answer})
        assert server is not None
        enter(None if has_login else login)
        async with server:
            return await asyncio.to_thread(send_command, PORT, "reload")

    assert asyncio.run(scenario()) == "done"


def test_a_socket_in_the_folder_of_another_user_does_not_hide_ours(
    short_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    foreign, ours = short_path / "foreign", short_path / "tmp" / f"driverview-{os.getuid()}"
    monkeypatch.setattr("tempfile.tempdir", str(short_path / "tmp"))
    monkeypatch.setattr(module, "_is_ours", lambda folder: folder != foreign)
    for folder in (foreign, ours):
        folder.mkdir(parents=True, mode=0o700)

    async def answer_as(name: str) -> asyncio.Server:
        async def answer(_model: str | None) -> str:
            return name

        server = await listen_for_commands(PORT, {"reload": answer})
        assert server is not None
        return server

    async def scenario() -> str:
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(foreign))
        theirs = await answer_as("theirs")
        monkeypatch.delenv("XDG_RUNTIME_DIR")
        async with theirs, await answer_as("ours"):
            monkeypatch.setenv("XDG_RUNTIME_DIR", str(foreign))
            return await asyncio.to_thread(send_command, PORT, "reload")

    assert asyncio.run(scenario()) == "ours"
