"""Segments of a log by sign; none reaches over a gap."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.errors import LogError
from greybox.trial.gaps import joined_spans, split_at_gaps
from greybox.trial.log import make_log
from greybox.trial.segments import by_sign
from greybox.vessel.toml import vessel_from_dict


def vessel(**sensors):
    return vessel_from_dict(
        {"name": "S", "length": 5, "thruster": [{"type": "fixed", "speed": "n"}]}
        | ({"sensors": sensors} if sensors else {})
    )


def log_of(u, v, ship=None, **more):
    return make_log(ship or vessel(), {"u": u, "v": v, **more}, 0.5)


def test_runs_keep_their_signs_with_the_margin():
    u = np.array([1.0, 1, 1, 0.1, -0.1, -1, -1, -1, -1, 1])
    v = np.array([0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, -0.5, -0.5, -0.5])
    runs = by_sign(log_of(u, v), {"u": 0.2, "v": 0.2})
    assert [(s.start, s.stop, s.label) for s in runs] == [
        (0, 3, "u+v+"),
        (5, 7, "u-v+"),
        (7, 9, "u-v-"),
        (9, 10, "u+v-"),
    ]
    assert all((np.abs(s.cut(log_of(u, v))["u"]) >= 0.2).all() for s in runs)


def test_short_runs_are_dropped_and_one_state_is_enough():
    u = np.array([1.0] * 10 + [-1.0] * 2 + [1.0] * 5)
    runs = by_sign(log_of(u, u), {"u": 0.1}, shortest=1.5)
    assert [(s.start, s.stop, s.label) for s in runs] == [(0, 10, "u+"), (12, 17, "u+")]
    assert runs[0].summary() == "u+: 0.0 to 4.5 s, 10 samples"


def test_known_noise_does_not_break_a_run():
    rng = np.random.default_rng(0)
    n = 600
    clean = np.where(np.arange(n) < 300, 0.5, -0.5)
    u = clean + 0.3 * rng.standard_normal(n)
    raw = by_sign(log_of(u, u), {"u": 0.2})
    smooth = by_sign(log_of(u, u, vessel(u_std=0.3)), {"u": 0.2})
    assert len(raw) > 50
    assert [s.label for s in smooth] == ["u+", "u-"]
    assert abs(smooth[0].stop - 300) <= 12
    assert abs(smooth[1].start - 300) <= 12


def test_mirroring_a_state_mirrors_its_label():
    rng = np.random.default_rng(1)
    u, v = (np.cumsum(rng.standard_normal(200)) / 5 for _ in range(2))
    one = by_sign(log_of(u, v), {"u": 0.1, "v": 0.1})
    two = by_sign(log_of(-u, v), {"u": 0.1, "v": 0.1})
    swap = str.maketrans("+-", "-+")
    assert [(s.start, s.stop, s.label[:2].translate(swap) + s.label[2:]) for s in one] == [
        (s.start, s.stop, s.label) for s in two
    ]


def test_gaps_split_a_log_and_its_runs():
    t = np.r_[np.arange(5), 7.0 + np.arange(4)] * 0.5
    assert split_at_gaps(t, 0.5) == [(0, 5), (5, 9)]
    assert split_at_gaps(t[:1], 0.5) == [(0, 1)]
    assert split_at_gaps(t[:0], 0.5) == []
    # spans that were written one after another join by the same rule
    assert joined_spans([(0.0, 1.0, 3), (1.5, 2.0, 2), (3.0, 4.0, 3)], 0.5) == [
        (0.0, 2.0, 5), (3.0, 4.0, 3),
    ]  # fmt: skip
    log = log_of(np.ones(9), np.ones(9), t=t)
    assert [(s.start, s.stop) for s in by_sign(log, {"u": 0.1})] == [(0, 5), (5, 9)]


def test_misuse_is_told():
    log = log_of(np.ones(9), np.ones(9))
    with pytest.raises(LogError, match="margin of u is -1"):
        by_sign(log, {"u": -1.0})
    with pytest.raises(LogError, match="no state was named"):
        by_sign(log, {})
    with pytest.raises(LogError, match="no channel 'r'"):
        by_sign(log, {"r": 0.1})
