"""The browser that tests of pages use: it has both graphics interfaces, and errors of a page are errors of the run."""

import subprocess
from pathlib import Path

import pytest

from tests.engines.conftest import HERE, RunNode

SUPPORT = """<script type="module">
const gl = document.createElement("canvas").getContext("webgl2");
window.result = { webgl: gl.getParameter(gl.VERSION), webgpu: Boolean(await navigator.gpu?.requestAdapter()) };
</script>"""


@pytest.mark.usefixtures("chromium")
def test_the_browser_has_webgl_and_webgpu(run_node: RunNode, tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text(SUPPORT)
    found = run_node("browser.mjs", "--webgpu", tmp_path, "index.html")
    assert "WebGL 2.0" in found["webgl"]
    assert found["webgpu"]


@pytest.mark.usefixtures("chromium")
@pytest.mark.parametrize(
    ("page", "says"),
    [
        ("<script>console.error('a red line'); window.result = 1</script>", "a red line"),
        ("<script>missing(); </script>", "missing is not defined"),
        ("<script src=nowhere.js></script><script>window.result = 1</script>", "404"),
        ("<img src=http://192.0.2.1/x.png><script>window.result = 1</script>", "the page asked for http://192.0.2.1/"),
    ],
)
def test_errors_of_a_page_fail(page: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text(page)
    command = ["node", str(HERE / "browser.mjs"), "--timeout=3000", str(tmp_path), "index.html"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert says in done.stderr
