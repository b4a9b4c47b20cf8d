"""The console script, which is ``python -m greybox`` too."""

from __future__ import annotations

import sys


def main() -> int:
    """Run the command line of the process; Ctrl-C ends it in a word while modules load, too."""
    try:
        from greybox.commands.main import main as run

        return run()
    except (KeyboardInterrupt, ImportError) as error:
        cause: BaseException | None = error
        # an extension that is interrupted while it loads says that it cannot be imported
        while cause and not isinstance(cause, KeyboardInterrupt):
            cause = cause.__cause__ or cause.__context__
        if cause is None:
            raise
        sys.stderr.write("greybox: stopped\n")
        return 130


if __name__ == "__main__":
    sys.exit(main())
