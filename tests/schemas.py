"""The published schemas, as validators."""

from __future__ import annotations

import json
from importlib.resources import files

from jsonschema import Draft202012Validator


def schema(name: str, package: str = "greybox") -> Draft202012Validator:
    data = json.loads((files(package) / "schema" / f"{name}.json").read_text(encoding="utf-8"))
    Draft202012Validator.check_schema(data)
    return Draft202012Validator(data)
