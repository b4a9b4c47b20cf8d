"""Model files of earlier versions, brought to the present one step by step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from greybox.errors import ModelFileError

VERSION = 4

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


def _from_2(data: Tables) -> Tables:
    """Version 2 had one verdict, on the coefficients, whose level was at first its text."""
    old = data.get("verdict")
    if not isinstance(old, dict):
        return {**data, "version": 3}
    said, reasons = str(old.get("text", "")), [str(r) for r in old.get("reasons", [])]
    found = next((w for w in _LEVELS if said.startswith(w)), "not judged")
    coefficients = {k: v for k, v in old.items() if k not in ("excepted", "reasons")} | {
        "level": old.get("level", found),
        "except": old.get("excepted", []),
        "reason": "; ".join(reasons),
    }
    return {**data, "verdict": {"coefficients": coefficients}, "version": 3}


def _from_3(data: Tables) -> Tables:
    """Version 3 had one estimate, for coefficients and prediction."""
    return {**data, "version": 4}


# from each version to the next
_STEPS: Mapping[int, Callable[[Tables], Tables]] = {1: _from_1, 2: _from_2, 3: _from_3}


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
    return data
