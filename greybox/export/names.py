"""Names from a model file where they must obey other rules: C, XML, comments."""

from __future__ import annotations

import re
from collections.abc import Iterable

# of C to C23 and of C++, since headers are included from both
_RESERVED = frozenset(
    """alignas alignof and asm auto bool break case catch char class concept const constexpr
    continue default delete do double else enum explicit export extern false float for friend goto
    if inline int long mutable namespace new noexcept not nullptr operator or private protected
    public register requires restrict return short signed sizeof static struct switch template this
    throw true try typedef typeid typename typeof union unsigned using virtual void volatile
    while xor main""".split()
)
_MOST = 60


def identifier(text: str) -> str:
    """Return a C identifier that reads like `text`, such as ``n_prop_rps`` of ``n_prop [rps]``."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_")[:_MOST]
    # names that begin with an underscore are the compiler's
    if not plain or plain[0].isdigit():
        plain = f"x_{plain}".rstrip("_")
    return f"x_{plain}" if plain in _RESERVED else plain


def identifiers(names: Iterable[str]) -> list[str]:
    """Return a C identifier for each name, all different."""
    return distinct(identifier(n) for n in names)


def distinct(names: Iterable[str]) -> list[str]:
    """Return the names, a number behind those that were there before."""
    found: list[str] = []
    for name in names:
        candidate, k = name, 2
        while candidate in found:
            candidate, k = f"{name}_{k}", k + 1
        found.append(candidate)
    return found


def line(text: str) -> str:
    """Return `text` on one line and of characters that every file can hold."""
    return "".join(
        " " if c in "\r\n\t\v\f\x85\u2028\u2029" else c if _writable(c) else "?" for c in text
    )


def comment(text: str) -> str:
    """Return `text` for a C comment, which it cannot end."""
    return line(text).replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")


def string(text: str) -> str:
    """Return `text` as a C string literal, in bytes of UTF-8."""
    out = []
    for byte in line(text).encode():
        keep = chr(byte).isprintable() and byte < 127 and chr(byte) not in '"\\?%'
        out.append(chr(byte) if keep else f"\\{byte:03o}")
    return f'"{"".join(out)}"'


def _writable(c: str) -> bool:
    # what XML 1.0 and UTF-8 can hold
    code = ord(c)
    return code >= 0x20 and code != 0x7F and not 0xD800 <= code < 0xE000 and code < 0xFFFE
