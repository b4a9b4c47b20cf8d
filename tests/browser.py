"""Pages in a real browser."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no browser installed")

_PROBE = (
    "<script>addEventListener('load',()=>{const e=document.documentElement;"
    "document.title=JSON.stringify([e.scrollWidth<=e.clientWidth,"
    "document.querySelector('svg').getBoundingClientRect().width>200,e.clientWidth])})"
    "</script></body>"
)


def require_legible(path: Path, width: int) -> None:
    """Open a page in a frame of a width [px]; it shows its figures and does not scroll sideways.

    The browser has nothing to complain of.
    """
    (path.parent / "probe.html").write_text(path.read_text().replace("</body>", _PROBE))
    # an own width needs a frame: a headless window is never narrower than 500 px
    outer = path.parent / "outer.html"
    outer.write_text(
        f"<iframe id=f src=probe.html width={width} height=800></iframe><script>"
        "addEventListener('load',()=>{document.title=f.contentDocument.title})</script>"
    )
    with tempfile.TemporaryDirectory() as profile:
        done = subprocess.run(
            [
                CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic",
                "--no-first-run", "--disable-background-networking", "--disable-component-update",
                "--disable-sync", "--allow-file-access-from-files", f"--user-data-dir={profile}",
                "--enable-logging=stderr",
                "--virtual-time-budget=5000", "--dump-dom", f"file://{outer}",
            ],
            capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip
    assert "<title>[true,true," in done.stdout, done.stdout[:500] + done.stderr[-500:]
    assert "CONSOLE" not in done.stderr, done.stderr[-500:]
