"""The C compiler of this machine, where there is one."""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from greybox.errors import ExportError

_LIMIT = 300
# contracted products would differ from machine to machine
FLAGS = ("-shared", "-fPIC", "-O3", "-ffp-contract=off", "-fvisibility=hidden")


def find_compiler() -> list[str] | None:
    """Return the words that call a C compiler: $CC, or cc, gcc or clang; None without one.

    Raises
    ------
    ExportError
        $CC names no program.
    """
    said = shlex.split(os.environ.get("CC", ""))
    if said:
        if shutil.which(said[0]) is None:
            raise ExportError(
                f"CC is '{os.environ['CC']}', and there is no program '{said[0]}': correct it, or "
                f"unset it."
            )
        return said
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name) is not None:
            return [name]
    return None


def fmi_platform() -> tuple[str, str]:
    """Return FMI's name of this machine's platform, and how libraries end there."""
    system, end = {"win32": ("win", ".dll"), "darwin": ("darwin", ".dylib")}.get(
        sys.platform, ("linux", ".so")
    )
    if system == "linux" and platform.machine().lower() not in ("x86_64", "amd64", "i386", "i686"):
        return f"{platform.machine().lower()}-linux", end
    return f"{system}{64 if sys.maxsize > 2**32 else 32}", end


def shared_library(
    compiler: list[str], texts: Mapping[str, str], defines: tuple[str, ...]
) -> bytes:
    """Compile C sources to a shared library and return its bytes.

    Parameters
    ----------
    compiler : list of str
    texts : mapping of str to str
        File name -> text; those that end with ``.c`` are compiled.
    defines : tuple of str
        Macros.

    Raises
    ------
    ExportError
        The compiler failed, or took too long.
    """
    with tempfile.TemporaryDirectory() as scratch:
        for name, text in texts.items():
            (Path(scratch) / name).write_text(text, encoding="utf-8")
        sources = sorted(name for name in texts if name.endswith(".c"))
        out = Path(scratch) / "library"
        strip = ["-s"] if sys.platform.startswith("linux") else []
        words = [*compiler, *FLAGS, *strip, *[f"-D{d}" for d in defines], "-o", out.name]
        try:
            done = subprocess.run(
                [*words, *sources, "-lm"], cwd=scratch, capture_output=True, text=True,
                errors="replace", timeout=_LIMIT,
            )  # fmt: skip
        except (OSError, subprocess.TimeoutExpired) as error:
            raise ExportError(
                f"'{compiler[0]}' did not compile the model ({error}): name another compiler in "
                f"CC, or leave the binary out with --no-binary."
            ) from error
        if done.returncode or not out.is_file():
            said = [s for s in (*done.stderr.splitlines(), *done.stdout.splitlines()) if s.strip()]
            raise ExportError(
                f"'{compiler[0]}' ended with status {done.returncode} "
                f"({said[0][:200] if said else 'and said nothing'}): name another compiler in CC, "
                f"or leave the binary out with --no-binary."
            )
        return out.read_bytes()
