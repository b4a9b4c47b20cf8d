"""Model files of earlier versions, brought to the present one step by step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from greybox.errors import ModelFileError

VERSION = 2

Tables = dict[str, Any]

# the longer one before its beginning
_LEVELS = ("do not trust", "trust except", "trust")


def _from_1(data: Tables) -> Tables:
    """Version 1 at first had no noise, nor its memory, nor covariances with the current."""
    noise = data.get("noise")
    empty: Tables = {"sums": {}, "disturbances": {}, "residual_std": {}}
    return {
        **empty,
        "disturbance_covariance": [],
        **data,
        "noise": {"memory": {}, **noise} if isinstance(noise, dict) else noise,
        "version": 2,
    }


# from each version to the next
_STEPS: Mapping[int, Callable[[Tables], Tables]] = {1: _from_1}


def upgraded(data: Tables, source: str) -> Tables:
    """Return the tables of a model file in their present form.

    Parameters
    ----------
    data : dict
        Of any version up to this one; not changed.
    source : str
        Name of the file, for messages.

    Raises
    ------
    ModelFileError
        The version is newer than this program knows, or is none.
    """
    version = data.get("version")
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        raise ModelFileError(
            f"'{source}' has version {version!r}, model files have a whole number from 1 to "
            f"{VERSION}: estimate the model again."
        )
    if version > VERSION:
        raise ModelFileError(
            f"'{source}' has version {version}, this program reads up to {VERSION}: "
            f"update the program."
        )
    for step in range(version, VERSION):
        data = _STEPS[step](data)
    return _with_level(data)


def _with_level(data: Tables) -> Tables:
    """Return the tables with the level of the estimate's verdict, which was at first its text."""
    verdict = data.get("verdict")
    if not isinstance(verdict, dict) or "level" in verdict:
        return data
    said = str(verdict.get("text", ""))
    level = next((w for w in _LEVELS if said.startswith(w)), "not judged")
    return {**data, "verdict": {**verdict, "level": level}}
