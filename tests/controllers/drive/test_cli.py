"""`controllers drive`: JSON on stdout, one error line on stderr, help."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

import trackfeatures as tf
from controllers.demo.process import free_port
from simulator.camera import KINDS
from tests.typed import error_line, typed


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return typed("controllers", *arguments)


def test_drive_prints_json_and_writes_the_log(tmp_path: Path) -> None:
    log = tmp_path / "drive.csv"
    done = run("drive", "--track", "oval", "--steps", "60", "--log", str(log), "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert (result["steps"], result["ended"]) == (60, None)
    assert result["score_per_step"] == pytest.approx(result["score"] / 60)
    assert len(log.read_text().splitlines()) == 61


def test_drive_prints_a_table() -> None:
    done = run("drive", "--track", "oval", "--steps", "20", "--controller", "torcs")
    assert done.returncode == 0, done.stderr
    assert "torcs on oval" in done.stdout
    assert "score_per_step" in done.stdout


def test_a_users_controller_in_one_file_drives(tmp_path: Path) -> None:
    law = tmp_path / "law.py"
    law.write_text(
        "class Proportional:\n"
        "    def update(self, observation):\n"
        "        steer = 2 * observation.angle - 0.2 * observation.to_lane_centre\n"
        "        return max(-1.0, min(steer, 1.0))\n"
    )
    done = run("drive", "--controller", f"{law}:Proportional", "--steps", "300", "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["ended"] is None
    assert result["mean_abs_d_m"] < 0.5


def test_lost_perception_is_reported() -> None:
    done = run("drive", "--steps", "80", "--drop", "0.99", "--json")
    assert done.returncode == 0, done.stderr
    slowed = json.loads(done.stdout)["slowed_steps"]
    assert slowed > 0
    assert f"slowed down for {slowed} steps" in done.stderr


def test_a_drive_on_the_wall_clock_reports_its_delays() -> None:
    began = time.monotonic()
    done = run("drive", "--steps", "10", "--realtime", "--json")
    assert done.returncode == 0, done.stderr
    assert time.monotonic() - began > 9 * 0.05
    result = json.loads(done.stdout)
    assert (result["steps"], result["late_answers"], result["lost_answers"]) == (10, 0, 0)
    assert 0 <= result["missed_steps"] < 10
    shown = run("drive", "--help").stdout.replace("│", " ")
    assert "The result differs from drive to drive" in " ".join(shown.split())


def test_a_service_that_does_not_answer_is_one_error_line() -> None:
    url = f"http://127.0.0.1:{free_port()}"
    done = run("drive", "--steps", "20", "--perception", url)
    assert done.returncode == 1
    assert url in error_line(done)


def test_the_help_of_drive_names_every_light_and_every_default() -> None:
    shown = " ".join(run("drive", "--help").stdout.replace("│", " ").split())
    assert all(kind in shown for kind in KINDS)
    # Rich drops text in square brackets, which these sentences must not have.
    assert "as in the paper; about a lap on other tracks." in shown
    assert "Default: 0.2. Not with --speed" in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--controller", "pid"), "no controller 'pid'; use one of: lqr, lqr-preview"),
        (("--latency-ms", "-5"), "latency of -5 ms"),
        (("--drop", "1.5"), "1.5 lost answers"),
        (("--realtime", "--latency-ms", "50"), "leave it out, or --latency-ms"),
        (("--realtime", "--drop", "1.5"), "1.5 lost answers"),
        (("--video", "drive.gif"), "ending in .mp4"),
        (("--video", "/no-such-folder/drive.mp4"), "there is no folder"),
        (("--parameters", "pyproject.toml"), "has no parameters of lqr-preview"),
        (("--lanes", "7"), "7"),
        (("--throttle", "2"), "throttle 2.0"),
        (("--speed", "15", "--throttle", "0.2"), "--speed 15 and --throttle 0.2 contradict"),
        (("--speed", "0"), "a speed of 0 m/s"),
        (("--speed", "nan"), "a speed of nan m/s"),
        (("--speed", "41"), "a speed of 41 m/s is out of range; give 1 to 40"),
        (("--steps", "0"), "0 steps"),
        (("--traffic", "99"), "99 traffic cars"),
        (("--light", "bogus"), "unknown light 'bogus'"),
        (("--track", "[/x]"), "there is no track '[/x]'"),
        (("--perception", "model", "--model", "no-such-run"), "no-such-run"),
        (("--log", "/no-such-folder/drive.csv"), "/no-such-folder/drive.csv"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
)
def test_a_wrong_option_is_one_error_line(arguments: tuple[str, ...], message: str) -> None:
    done = run("drive", "--steps", "20", *arguments)
    assert done.returncode == 1, done.stdout
    assert message in error_line(done)


DYING_SERVICE = """
import http.server, json, os, sys
CAMERA = dict(width=56, height=42, fov_y_deg=67.5, x=0.75, y=0.0, z=0.95, pitch_deg=0.0)
HEADING = dict(left=0.0, straight=1.0, right=0.0)
FEATURES = dict(to_lane_centre_m=0.0, angle_rad=0.0, heading=HEADING)
asked = 0

class Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def answer(self, content):
        body = json.dumps(content).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def do_GET(self):
        self.answer(dict(definitions_version=sys.argv[1], camera=CAMERA))

    def do_POST(self):
        global asked
        asked += 1
        if asked > 5:
            os._exit(9)
        self.rfile.read(int(self.headers["Content-Length"]))
        self.answer(FEATURES)

    def log_message(self, *words):
        pass

server = http.server.HTTPServer(("127.0.0.1", 0), Handler)
print(server.server_port, flush=True)
server.serve_forever()
"""


def test_a_service_that_dies_in_a_drive_is_one_error_line_and_the_log_is_kept(
    tmp_path: Path,
) -> None:
    log = tmp_path / "drive.csv"
    command = [sys.executable, "-c", DYING_SERVICE, tf.VERSION]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as service:
        assert service.stdout is not None
        url = f"http://127.0.0.1:{service.stdout.readline().strip()}"
        done = run("drive", "--steps", "50", "--perception", url, "--log", str(log))
        assert service.wait(120) == 9
    assert done.returncode == 1, done.stdout
    assert url in error_line(done)
    assert len(log.read_text().splitlines()) == 1 + 5


def test_a_track_where_the_car_cannot_start_is_one_error_line(tmp_path: Path) -> None:
    """A climb of 29 % at the start: gear 1 and a fifth of the throttle do not hold the car."""
    straight = '[[segment]]\ntype = "straight"\nlength = 80.0\ngrade = {}\n'
    bend = '[[segment]]\ntype = "bend"\nradius = 45.0\nangle = 90.0\nspiral = 20.0\n'
    grades = (29.0, -29.0, -29.0, 29.0)
    track, log = tmp_path / "climb.toml", tmp_path / "drive.csv"
    head = 'look = "mountain"\nsurface = "asphalt"\nwidth = 10.0\nvertical_curve = 20.0\n'
    track.write_text(head + "".join(straight.format(grade) + bend for grade in grades))
    done = run("drive", "--track", str(track), "--steps", "200", "--log", str(log), "--json")
    assert (done.returncode, done.stdout) == (1, "")
    error = error_line(done)
    assert "the car did not start" in error
    assert "backwards" in error
    assert len(log.read_text().splitlines()) > 2


def test_a_car_that_stands_did_not_start() -> None:
    done = run("drive", "--throttle", "0", "--steps", "250")
    assert done.returncode == 1
    assert "error: the car did not start" in done.stderr
    assert "stood" in done.stderr


def test_the_error_of_a_set_speed_is_reported() -> None:
    done = run("drive", "--speed", "12", "--steps", "500", "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["speed_error_m_s"] < 0.2
    assert result["speed_kmh"][1] == pytest.approx(12 * 3.6, abs=2.0)
    held = json.loads(run("drive", "--steps", "20", "--json").stdout)
    assert "speed_error_m_s" not in held
