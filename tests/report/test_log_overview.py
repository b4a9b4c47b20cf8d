"""Pictures of a log: units on every axis, breaks at gaps, peaks kept, missing channels."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import PolyCollection

from greybox.report.figures import to_svg
from greybox.report.log import facts, page_figures
from greybox.report.thinning import find_gaps, longest, pick, thin
from greybox.report.track import even_times
from greybox.trial.log import make_log
from greybox.vessel.toml import vessel_from_dict

NONE = np.array([], np.intp)


def sailed(ship, n=300, keep=None, ts=0.5):
    """A ship of the thesis that weaves north-east under wind from the south-east."""
    t = np.arange(n) * ts
    psi = 0.7 + 0.6 * np.sin(0.05 * t)
    u, v, r = 2 + 0 * t, 0.1 * np.sin(0.05 * t), 0.03 * np.cos(0.05 * t)
    c, s = np.cos(psi), np.sin(psi)
    channels = {
        "t": t, "x_n": np.cumsum(c * u - s * v) * ts, "y_n": np.cumsum(s * u + c * v) * ts,
        "psi": psi, "u": u, "v": v, "r": r, "n": 15 + 0 * t,
        "alpha1": 0.8 + 0.1 * np.sin(t), "alpha2": 0.8 + 0.1 * np.cos(t),
        "u_q": u - (c * 3 - s * 3), "v_q": v + (s * 3 + c * 3),
    }  # fmt: skip
    if keep is not None:
        channels = {k: value[keep] for k, value in channels.items()}
    return make_log(ship, channels, ts, "sailed")


def drawn_labels(figure):
    return [text for ax in figure.axes for text in (ax.get_xlabel(), ax.get_ylabel()) if text]


def signals(log):
    return page_figures(log)["signals"]


def axis(figure, word):
    (found,) = [ax for ax in figure.axes if word in ax.get_ylabel()]
    return found


def test_every_axis_has_its_unit(ship):
    figures = page_figures(sailed(ship))
    labels = [label for figure in figures.values() for label in drawn_labels(figure)]
    for label in labels:
        assert "[" in label, label
    text = " ".join(labels).replace("\n", " ")
    for wanted in (
        "east [m]", "north [m]", "velocity over ground [m/s]", "yaw rate r [deg/s]",
        "heading ψ [deg]", "propeller speed n [unit of the log]", "thruster angle [deg]",
        "true wind speed [m/s]", "true wind from [deg from north]",
        "time from the first sample [s]",
    ):  # fmt: skip
        assert wanted in text


def test_angles_are_in_degrees_and_wind_from_where_it_comes(ship):
    log = sailed(ship)
    figure = signals(log)
    np.testing.assert_allclose(axis(figure, "heading").lines[0].get_ydata(), np.degrees(log["psi"]))
    np.testing.assert_allclose(axis(figure, "yaw rate").lines[0].get_ydata(), np.degrees(log["r"]))
    # 3 m/s towards north and 3 m/s towards west: from south-east
    origin = axis(figure, "wind from").lines[0].get_ydata()
    np.testing.assert_allclose(np.mod(origin, 360), 135, atol=1e-6)
    np.testing.assert_allclose(
        axis(figure, "wind\nspeed").lines[0].get_ydata(), 3 * np.sqrt(2), atol=1e-9
    )


def test_long_names_of_many_thrusters_leave_the_curves_their_room():
    speeds, angles = ([f"{what}_of_thruster_{k}_{'x' * 30}" for k in range(8)]
                      for what in ("speed", "azimuth"))  # fmt: skip
    thrusters = [{"type": "azimuth", "x": 1.0 * k, "speed": speeds[k], "angle": angles[k]}
                 for k in range(8)]  # fmt: skip
    vessel = vessel_from_dict({"name": "eight", "length": 60.0, "thruster": thrusters})
    wave = np.sin(np.arange(50.0))
    figure = signals(make_log(vessel, dict.fromkeys([*speeds, *angles, "u"], wave), 1.0))
    # what finds no room is warned of
    assert to_svg(figure, "eight").startswith("<svg")
    assert all(ax.get_position().width > 0.6 for ax in figure.axes)
    assert all(ax.get_position().height * figure.get_figheight() > 0.8 for ax in figure.axes)


def test_coordinates_of_a_grid_are_written_in_full(ship):
    log = sailed(ship)
    far = {**log.channels, "x_n": log["x_n"] + 6512345, "y_n": log["y_n"] + 598765}
    figure = page_figures(replace(log, channels=far))["track"]
    svg = to_svg(figure, "far")
    assert figure.axes[0].yaxis.get_offset_text().get_text() == ""
    assert any(t.get_text().startswith("65123") for t in figure.axes[0].get_yticklabels())
    assert "<svg" in svg


def test_the_map_has_north_up_and_equal_axes(ship):
    log = sailed(ship)
    figure = page_figures(log)["track"]
    (ax,) = figure.axes
    assert ax.get_aspect() == 1.0
    track = ax.lines[0]
    np.testing.assert_allclose(track.get_xdata(), log["y_n"])
    np.testing.assert_allclose(track.get_ydata(), log["x_n"])
    (hulls,) = [c for c in ax.collections if isinstance(c, PolyCollection)][:1]
    first = hulls.get_paths()[0].vertices
    bow = first[0] - first[:-1].mean(axis=0)
    # the bow points along the heading: east part sin ψ, north part cos ψ
    np.testing.assert_allclose(
        bow / np.hypot(*bow), [np.sin(log["psi"][0]), np.cos(log["psi"][0])], atol=1e-9
    )
    words = [text.get_text() for text in ax.get_legend().get_texts()]
    assert {"start", "end"} <= set(words)
    assert any("ship every 10 s" in w for w in words)
    assert any("true wind blows, up to 4.2 m/s" in w for w in words)
    calm = {k: v for k, v in log.channels.items() if k not in ("u_q", "v_q")}
    without = page_figures(replace(log, channels=calm))["track"].axes[0].get_legend().get_texts()
    assert not any("wind" in text.get_text() for text in without)


def test_ships_stand_at_the_body_origin(ship):
    ahead = replace(ship, sensors={"antenna": (10.0, 0.0)})
    log = sailed(ahead)
    hulls = page_figures(log)["track"].axes[0].collections[0]
    outline = hulls.get_paths()[0].vertices[:-1]
    middle = (outline[0] + (outline[2] + outline[3]) / 2) / 2
    psi = log["psi"][0]
    np.testing.assert_allclose(
        middle, [log["y_n"][0] - 10 * np.sin(psi), log["x_n"][0] - 10 * np.cos(psi)]
    )


def test_lines_break_and_shade_at_gaps(ship):
    keep = np.r_[0:100, 160:200, 203:300]
    log = sailed(ship, keep=keep)
    figure = signals(log)
    for word in ("velocity", "heading", "propeller", "speed [m/s]"):
        ax = axis(figure, word)
        for line in ax.lines:
            y = line.get_ydata()
            assert np.isnan(y).sum() == 2
            assert np.isnan(y[100])
        (shades,) = [c for c in ax.collections if c.get_label() == "gap"]
        spans = [(p.vertices[:, 0].min(), p.vertices[:, 0].max()) for p in shades.get_paths()]
        np.testing.assert_allclose(spans, [(49.5, 80.0), (99.5, 101.5)])
    (track,) = page_figures(log)["track"].axes
    assert np.isnan(track.lines[0].get_xdata()).sum() == 2
    assert "2 gaps, 31.5 s missing" in facts(log)
    assert "no gaps" in facts(sailed(ship))


# words on the axes of each part
DRAWN = {
    "states": ("velocity", "yaw rate", "heading"),
    "inputs": ("propeller", "thruster angle"),
    "wind": ("wind",),
}


@pytest.mark.parametrize(
    ("left_out", "parts"),
    [
        (("x_n", "y_n"), {"states", "inputs", "wind"}),
        (("u_q", "v_q"), {"track", "states", "inputs"}),
        (("n", "alpha1", "alpha2"), {"track", "states", "wind"}),
        (("psi", "u", "v", "r"), {"track", "inputs", "wind"}),
        (("psi", "u", "v", "r", "n", "alpha1", "alpha2", "u_q", "v_q"), {"track"}),
        (("x_n", "y_n", "psi", "v", "r", "n", "alpha1", "u_q"), {"states", "inputs"}),
    ],
)
def test_missing_channels(ship, left_out, parts):
    log = sailed(ship)
    log = replace(log, channels={k: v for k, v in log.channels.items() if k not in left_out})
    figures = page_figures(log)
    assert ("track" in figures) == ("track" in parts)
    labels = drawn_labels(figures["signals"]) if "signals" in figures else []
    for part, words in DRAWN.items():
        assert any(w in label for label in labels for w in words) == (part in parts), part
    assert all("[" in label for label in labels)
    for name, figure in figures.items():
        assert to_svg(figure, name).startswith("<svg")


def test_wind_without_a_heading_is_apparent(ship):
    log = sailed(ship)
    log = replace(log, channels={k: log[k] for k in ("u_q", "v_q")})
    labels = " ".join(drawn_labels(signals(log))).replace("\n", " ")
    assert "apparent wind from [deg from bow]" in labels


def test_inputs_share_axes_by_unit():
    vessel = vessel_from_dict(
        {
            "name": "S",
            "length": 5,
            "thruster": [
                {"type": "propeller_rudder", "speed": "n", "rudder": "delta", "x": -2.0},
                {"type": "tunnel", "speed": "bow", "x": 2.0},
                {"type": "tunnel", "speed": "stern [rps]", "x": -2.0},
                {"type": "fixed", "speed": "n (aft)"},
            ],
            "columns": {
                "Shaft": {"name": "n", "unit": "rpm"}, "Aft": {"name": "n (aft)", "unit": "N"}
            },
        }
    )  # fmt: skip
    wave = np.sin(np.arange(50.0))
    inputs = dict.fromkeys(("n", "bow", "stern [rps]", "n (aft)", "delta", "u"), wave)
    log = make_log(vessel, inputs, 1.0)
    assert [ax.get_ylabel() for ax in signals(log).axes] == [
        "velocity over\nground [m/s]",
        "propeller speed n\n[rpm]",
        "propeller speed bow\n[unit of the log]",
        "propeller speed stern\n[rps]",
        "propeller speed\nn (aft)\n[N]",
        "rudder angle delta\n[deg]",
    ]


def test_a_controller_is_shown_where_the_log_tells_of_it(ship):
    log = sailed(ship)
    on = np.zeros(len(log), bool)
    on[20:60] = True
    log = replace(log, closed_loop=on, loop_known=True)
    figure = signals(log)
    (bars,) = [c for c in axis(figure, "propeller").collections if c.get_label() == "controller on"]
    x = bars.get_paths()[0].vertices[:, 0]
    np.testing.assert_allclose([x.min(), x.max()], [10.0, 29.5])
    assert "13 % under a controller" in facts(log)


def test_long_logs_are_small_and_drawn_fast(ship):
    log = sailed(ship, 1_000_000, ts=0.1)
    noise = np.random.default_rng(0).standard_normal(len(log))
    noisy = {k: v + 0.05 * np.roll(noise, 7 * i) for i, (k, v) in enumerate(log.channels.items())}
    noisy["u"][123_456] = 50.0
    log = replace(log, channels=noisy)
    start = time.perf_counter()
    figure = signals(log)
    svg = to_svg(figure, "long")
    assert time.perf_counter() - start < 10
    assert len(svg) < 2_000_000
    for ax in figure.axes:
        for line in ax.lines:
            assert len(line.get_xdata()) <= 2100
    # the one outlier among a million is what a reader looks for
    assert max(axis(figure, "velocity").lines[0].get_ydata()) == 50.0
    assert "[h]" in " ".join(drawn_labels(figure))


def test_thinning_keeps_extremes_ends_and_breaks():
    rng = np.random.default_rng(1)
    value = np.cumsum(rng.standard_normal(50_000))
    gaps = np.array([10_000, 10_005, 33_333])
    index = thin(gaps, value, points=400)
    kept = index[index >= 0]
    assert (np.diff(kept) > 0).all()
    assert len(index) < 450
    assert {0, 49_999, 10_000, 10_001, 10_005, 10_006, 33_333, 33_334} <= set(kept)
    assert value[kept].max() == value.max()
    assert value[kept].min() == value.min()
    # each break stands between the samples on its two sides
    for k, place in zip(gaps, np.flatnonzero(index < 0), strict=True):
        assert index[place - 1] == k
        assert index[place + 1] == k + 1
    assert np.isnan(pick(value, index)).sum() == 3
    # a slow oracle: every two hundredth part of the log keeps both of its extremes
    for part in np.split(np.arange(50_000), 200):
        inside = value[kept[(kept >= part[0]) & (kept <= part[-1])]]
        assert inside.max() == value[part].max()
        assert inside.min() == value[part].min()
    np.testing.assert_array_equal(thin(NONE, value[:300]), np.arange(300))


def test_gaps():
    t = np.array([0, 1, 2, 3.4, 4.4, 6.0, 7, 20])
    gaps = find_gaps(t, 1.0)
    np.testing.assert_array_equal(gaps, [4, 6])
    np.testing.assert_array_equal(longest(gaps, t, 1), [6])
    np.testing.assert_array_equal(longest(gaps, t, 2), gaps)


@pytest.mark.parametrize(
    ("span", "step"), [(0.0, 0.1), (1.0, 0.1), (60.0, 5), (600.0, 60), (86400.0, 7200.0)]
)
def test_even_times(span, step):
    t = 1000 + np.linspace(0, span, 5000 if span else 1)
    got, chosen = even_times(t, span / 4999 or 1.0)
    assert got == step
    assert 1 <= len(chosen) <= 18
    np.testing.assert_allclose(t[chosen], 1000 + step * np.arange(len(chosen)), atol=span / 5000)


def test_no_ship_is_drawn_in_a_gap():
    t = np.r_[0:40, 61:100].astype(float)
    step, chosen = even_times(t, 1.0)
    assert step == 10
    np.testing.assert_array_equal(t[chosen], [0, 10, 20, 30, 70, 80, 90])
