"""The wind on a free-running tanker model: found by command, proved on runs of other hours."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from greybox.commands.main import main

TANKER = """
name = "3 m tanker model"
length = 3.0
mass = 244.6
[[thruster]]
type = "propeller_rudder"
x = -1.5
speed = "n_prop [rps]"
rudder = "delta_rudder [rad]"
"""


@pytest.mark.long
def test_the_wind_is_found_in_a_tankers_trials(data_folder: Path, tmp_path: Path) -> None:
    vessel = tmp_path / "tanker.toml"
    vessel.write_text(TANKER)
    logs = []
    for raw in sorted((data_folder / "esso_osaka").glob("*.csv")):
        log = tmp_path / raw.name
        assert main(["import", str(raw), "--vessel", str(vessel), "--fix", "--out", str(log)]) == 0
        logs.append(str(log))
    result = tmp_path / "d.json"
    assert main(["diagnose", *logs[::2], "--vessel", str(vessel), "--sample-time", "1",
                 "--validate", *logs[1::2], "--json", str(result)]) == 0  # fmt: skip
    found = json.loads(result.read_text())
    # two missing samples of a position cut no run
    assert "turn_14-Sep-2020_14_16_04," in found["validated_on"]
    # what makes held-out runs worse is not told as a help
    helped = [c["held_out_gain"]["value"] for c in found["partial"]]
    assert all(value is None or value > 0 for value in helped)
    # nor what may be chance
    assert all(c["p_adjusted"] < 0.01 for c in found["partial"])
    # a pond has no current
    assert "current" not in {c["id"] for c in found["causes"]}
    # what the wind leaves decides whether it stands alone or only helps
    (wind,) = (c for c in (*found["causes"], *found["partial"]) if c["id"] == "wind")
    # a force against the velocity through the air in surge and sway
    for name in ("Wuu", "Wvv"):
        assert wind["parameters"][name]["value"] < 0
    assert wind["p_adjusted"] < 1e-10
    # beyond (3.51) whose free runs are as near as they can be
    for state in ("u", "v", "r"):
        gain = found["gain"][state]
        assert gain["after"] > 55, state
        assert gain["ci"][0] > 5, state
