"""Opens every page of the built manual in a browser: python docs/check_pages.py FOLDER.

At 1280 and at 390 px a page does not scroll sideways and the browser has nothing to complain of;
on A4 nothing of its text is wider than the sheet. Without a browser nothing is checked.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import pytest
from browser import driven

from greybox.errors import so_many

# what a laptop and a phone show [px], and A4 without its margins at 96 dots per inch
WIDTHS = {"a laptop": 1280, "a phone": 390}
SHEET = 703
SIDEWAYS = "const e = document.documentElement; return e.scrollWidth - e.clientWidth"
# text of the page itself that reaches beyond the sheet; drawers at its sides are not printed
CUT_OFF = """
    const sheet = arguments[0], text = document.querySelector("[role=main]") || document.body;
    return [...text.querySelectorAll("p, li, td, pre, img, h1, h2, h3, dt")].filter(
      (e) => e.getClientRects().length && e.getBoundingClientRect().right > sheet + 1
    ).map((e) => e.tagName + ": " + e.textContent.trim().slice(0, 40));
"""


def sized(browser, width):
    """Give a browser's page a width [px]."""
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": False},
    )


def faults(page):
    """Yield what is wrong with a page."""
    with driven(page) as browser:
        yield from (f"the browser says: {e['message']}" for e in browser.get_log("browser"))
        for screen, width in WIDTHS.items():
            sized(browser, width)
            if (beyond := browser.execute_script(SIDEWAYS)) > 0:
                yield f"on {screen} of {width} px it scrolls sideways by {beyond} px"
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
        sized(browser, SHEET)
        yield from (f"cut off on A4: {e}" for e in browser.execute_script(CUT_OFF, SHEET)[:3])


def main(folder):
    """Return how many faults were found and told."""
    pages = sorted(p for p in Path(folder).resolve().rglob("*.html") if "_static" not in p.parts)
    try:
        told = [f"{page.name}: {fault}" for page in pages for fault in faults(page)]
    except pytest.skip.Exception as reason:
        print(f"pages were not opened: {reason}")
        return 0
    opened = so_many(len(pages), "page")
    print("\n".join(told) or f"{opened} opened in a browser: nothing is cut off")
    return len(told)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]) > 0)
