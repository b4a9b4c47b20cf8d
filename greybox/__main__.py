"""``python -m greybox`` is the console script."""

from __future__ import annotations

import sys

from greybox.commands.main import main

if __name__ == "__main__":
    sys.exit(main())
