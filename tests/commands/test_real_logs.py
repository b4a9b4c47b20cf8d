"""The commands on real logs, where there are any (GREYBOX_DATA)."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd

from greybox.commands.main import main
from greybox.trial.convert.read import read_log
from greybox.vessel.toml import load_vessel

BLUEBOAT = """
name = "Catamaran"
length = 1.2
[[thruster]]
type = "fixed"
y = -0.285
speed = "left_force"
[[thruster]]
type = "fixed"
y = 0.285
speed = "right_force"
[columns]
"original_timestamp" = { name = "t", unit = "ms" }
"x_ned" = { name = "x_n", unit = "m" }
"y_ned" = { name = "y_n", unit = "m" }
"yaw" = { name = "psi", unit = "deg" }
"surge" = { name = "u", unit = "m/s" }
"sway" = { name = "v", unit = "m/s" }
"yaw_rate" = { name = "r", unit = "rad/s" }
"""


def test_ferry(data_folder, tmp_path, capsys):
    """Estimated on the first two thirds, run freely on the last."""
    raw = pd.read_csv(data_folder / "milliampere1" / "maneuvering1.csv")
    cut = 2 * len(raw) // 3
    first, last = tmp_path / "first.csv", tmp_path / "last.csv"
    raw.iloc[:cut].to_csv(first, index=False)
    raw.iloc[cut:].to_csv(last, index=False)
    model = tmp_path / "ferry.json"
    assert main(["estimate", str(first), "--vessel", "ferry", "--sample-time", "1",
                 "--out", str(model)]) == 0  # fmt: skip
    shown = capsys.readouterr().out
    assert "closed loop" in shown
    data = json.loads(model.read_text())
    assert all(np.isfinite(data["std"]))
    assert data["units"][data["names"].index("Nmu")] == "1/(m s N)"
    # thrust to starboard forward turns the bow to starboard: the columns have their signs right
    gain = data["names"].index("Nmu")
    assert data["theta"][gain] > 3 * data["std"][gain]
    result = tmp_path / "c.json"
    assert main(["compare", str(model), "--log", str(last), "--json", str(result),
                 "--report", str(tmp_path / "c.html")]) == 0  # fmt: skip
    assert set(json.loads(result.read_text())["models"][0]["fit"]) == {"u", "v", "r"}


def test_ferry_log_is_read_with_its_units(data_folder):
    vessel = load_vessel("ferry")
    log = read_log(data_folder / "milliampere1" / "maneuvering1.csv", vessel)
    assert log.sample_time == 0.1
    assert abs(log["alpha1"][0] - np.deg2rad(130.47)) < 0.05
    assert 0.7 < log.closed_loop.mean() < 0.8
    assert np.abs(log["u"]).max() < 0.3  # it hardly leaves its berth


def test_catamaran_through_chapter7(data_folder, tmp_path, capsys):
    vessel = tmp_path / "boat.toml"
    vessel.write_text(BLUEBOAT)
    folder = data_folder / "blueboat"
    names = [str(folder / f"fixed_00000{n}.csv") for n in (220, 222, 224, 226, 233)]
    assert main(["reproduce", "chapter7", "--vessel", str(vessel), "--estimate", *names[:3],
                 "--validate", *names[3:], "--out", str(tmp_path / "c7")]) == 0  # fmt: skip
    assert "3 of 2 logs" in capsys.readouterr().out.replace("estimation sets: ", "")
