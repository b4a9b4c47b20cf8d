"""Trustworthy ship models from sea trials.

The names here are the promised ones; each is loaded when it is first used, so
that importing the package, or asking for help, costs nothing.

Examples
--------
>>> import greybox as gb
>>> gb.get_structure("thesis").parameters[:3]
('Xu', 'Xvr', 'Xuu')
"""

import logging

from greybox.public import lazy_names

# a library is silent until the program that uses it asks to hear
logging.getLogger(__name__).addHandler(logging.NullHandler())

__getattr__, __dir__, __all__ = lazy_names(__name__)
