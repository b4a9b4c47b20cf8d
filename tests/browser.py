"""Pages in a real browser."""

from __future__ import annotations

import atexit
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from greybox.report.interactive import library, opener

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no browser installed")


def without_scripts(html: str) -> str:
    """Return a page without the two scripts that are its own, which hold addresses and markup."""
    for script in (library(), opener()):
        html = html.replace(f"<script>{script}</script>", "")
    return html


def require_legible(path: Path, width: int) -> None:
    """Open a page in a frame of a width [px]; it shows its figures and does not scroll sideways.

    The browser has nothing to complain of.
    """
    # an own width needs a frame: a headless window is never narrower than 500 px
    outer = path.parent / "outer.html"
    outer.write_text(f"<iframe id=f src={path.name} width={width} height=800></iframe>")
    with driven(outer) as browser:
        shown = browser.execute_script(
            "const d=f.contentDocument,e=d.documentElement;return [e.scrollWidth<=e.clientWidth,"
            "d.querySelector('svg').getBoundingClientRect().width>200]"
        )
        assert shown == [True, True]
        assert [e["message"] for e in browser.get_log("browser")] == []


@contextmanager
def driven(path: Path, width: int = 1280, *, touch: bool = False) -> Iterator[Any]:
    """Open a page in a browser that can be clicked, scrolled and dragged.

    Skips where the browser's driver or its client is missing.
    """
    browser = _started(width, touch)
    browser.get(f"file://{path}")
    try:
        yield browser
    finally:
        for command, given in (
            ("clearDeviceMetricsOverride", {}),
            ("setEmulatedMedia", {"media": ""}),
        ):
            browser.execute_cdp_cmd(f"Emulation.{command}", given)
        browser.get("about:blank")
        # what it complained of is not for the next page
        browser.get_log("browser")


@cache
def _started(width: int, touch: bool) -> Any:
    """Start a browser that all tests of a process share; it takes longer than what they ask."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="no selenium installed")
    driver = shutil.which("chromedriver")
    if CHROMIUM is None or driver is None:
        pytest.skip("no browser with chromedriver installed")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in (
        "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
        "--disable-background-networking", "--disable-component-update", "--disable-sync",
        "--allow-file-access-from-files", f"--window-size={width},900",
    ):  # fmt: skip
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    if touch:
        metrics = {"width": width, "height": 800, "pixelRatio": 2, "touch": True}
        options.add_experimental_option("mobileEmulation", {"deviceMetrics": metrics})
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    atexit.register(browser.quit)
    return browser
