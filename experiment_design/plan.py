"""The plan as a file: commands at the sample time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiment_design.result import Design
from greybox.files import replacing


def write_plan(design: Design, path: str | Path) -> None:
    """Write the commands as CSV of ``t`` and the thruster columns, ``trial`` first if several.

    Each row holds from its time on until the next.

    Parameters
    ----------
    design : Design
    path : str or Path
    """
    r = design.request
    names = r.schedule.commands
    several = r.trials > 1
    with replacing(path) as handle:
        handle.write(",".join([*(["trial"] if several else []), "t", *names]) + "\n")
        for trial, commands in enumerate(design.commands):
            t = np.arange(len(commands)) * r.sample_time
            for k, row in enumerate(commands):
                cells = [f"{t[k]:.10g}", *(f"{v:.10g}" for v in row)]
                handle.write(",".join([*([str(trial + 1)] if several else []), *cells]) + "\n")
