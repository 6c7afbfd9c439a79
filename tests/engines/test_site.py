"""The page as `prtbake export` writes it and as `prtbake view --browser` serves it, in Chromium."""

import functools
import signal
import subprocess
import sys
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from prt_bake.cli.main import main
from tests import ROOT
from tests.engines.conftest import RunNode


def test_a_site_of_two_objects_on_a_plain_web_server(
    chromium: str, run_node: RunNode, spot: Path, tmp_path: Path
) -> None:
    """Python's own server, as the command names it; both objects meet their self-tests."""
    assert main(["export", str(spot / "spot.h5"), "-o", str(tmp_path / "cow.glb"), "--quantize", "int8"]) == 0
    site = ["export", str(spot / "spot.h5"), str(tmp_path / "cow.glb"), "-o", str(tmp_path / "site")]
    assert main([*site, "--light", str(spot / "sky.hdr"), "--light", "sun:1,1,0:3,2,1"]) == 0
    handler = functools.partial(SimpleHTTPRequestHandler, directory=str(tmp_path / "site"))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        found = run_node("open_site.mjs", f"http://127.0.0.1:{server.server_port}/")
        server.shutdown()
        thread.join()
    assert [each["name"] for each in found["objects"]] == ["spot", "cow"]
    assert [each["check"] for each in found["objects"]] == ["meets its self-test"] * 2
    assert found["lights"][:2] == ["sky.hdr", "sun:1,1,0:3,2,1"]


def test_view_browser_serves_a_page_that_meets_the_self_test(chromium: str, run_node: RunNode, spot: Path) -> None:
    command = [sys.executable, "-m", "prt_bake", "view", "spot.h5", "--browser"]
    environment = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}  # without a display
    with subprocess.Popen(command, cwd=spot, env=environment, stdout=subprocess.PIPE, text=True) as serving:
        assert serving.stdout is not None
        found = run_node("open_site.mjs", serving.stdout.readline().strip())
        serving.send_signal(signal.SIGINT)
    assert serving.returncode == 130
    assert [each["check"] for each in found["objects"]] == ["meets its self-test"]
    assert found["objects"][0]["selftest"] <= 1e-3
    assert found["lights"][0] == "sky.hdr"
