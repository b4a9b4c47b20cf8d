"""Design of trials: the most informative thruster sequences, and their predicted precision.

Imports run down this list, never up: `command` and `demo`; what a program calls
(`discriminate`, `design`, `duration`, `prepare`, `precision`); `output`; `certificate` and
`feasibility`; `optimise`; `request`; `criteria` and `constraints`; `information`;
`excitation`.

Stands on `greybox` and is never imported by it. The names here are the promised
ones; each is loaded when it is first used.
"""

import logging

from greybox.public import lazy_names

# a library is silent until the program that uses it asks to hear
logging.getLogger(__name__).addHandler(logging.NullHandler())

__getattr__, __dir__, __all__ = lazy_names(__name__)
