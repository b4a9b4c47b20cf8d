"""Checks the links of the built pages: python docs/check_links.py docs/_build.

Links between pages must lead to a file and an anchor that exist. Links to other sites are asked for
where there is a network; without one only their form is checked, and that is said.
"""

import subprocess
import sys
import urllib.error
import urllib.request
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class Page(HTMLParser):
    """What a page links to, and what can be linked to in it."""

    def __init__(self, path):
        super().__init__()
        self.links, self.anchors = set(), {""}
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        """Note ids and targets."""
        for name, value in attrs:
            if name in ("id", "name") and value:
                self.anchors.add(value)
            if name in ("href", "src") and value:
                self.links.add(value)


def broken_links(folder):
    """Return a sentence for each link that leads nowhere, and the set of external links."""
    folder = Path(folder).resolve()
    pages = {p: Page(p) for p in sorted(folder.rglob("*.html"))}
    wrong, external = [], set()
    for path, page in pages.items():
        for link in sorted(page.links):
            parts = urlsplit(link)
            if parts.scheme in ("http", "https"):
                external.add(link)
                if not parts.hostname or "." not in parts.hostname:
                    wrong.append(f"{path.name}: '{link}' names no site")
                continue
            if parts.scheme:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.exists():
                wrong.append(f"{path.name}: there is no '{link}'")
            elif target in pages and unquote(parts.fragment) not in pages[target].anchors:
                wrong.append(f"{path.name}: '{link}' has no such anchor")
    return wrong, external


def network():
    """Return whether other sites can be reached."""
    try:
        urllib.request.urlopen("https://www.sphinx-doc.org", timeout=5).close()
    except (urllib.error.URLError, OSError):
        return False
    return True


def main(folder):
    """Check, tell, and return the exit status."""
    wrong, external = broken_links(folder)
    print("\n".join(wrong) or "internal links and anchors: all lead somewhere")
    if not network():
        print(f"no network: the form of {len(external)} external links was checked, not more")
    elif not wrong:
        source = str(Path(__file__).parent)
        command = [sys.executable, "-m", "sphinx", "-q", "-b", "linkcheck", source]
        return subprocess.run([*command, f"{folder}/linkcheck"], check=False).returncode
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
