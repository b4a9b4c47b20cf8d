"""What was tried is one table, in lines, cells and JSON."""

from __future__ import annotations

import json

from greybox.estimation.tried import Comparison, TriedModel
from greybox.files import plain

ROWS = (
    TriedModel("thesis", "augmented", "iv", 1.0, "n", 19, 80.0, 0.5, 0.8, True),
    TriedModel("linear", "basic", "ls", 1.0, "n", 9, 80.5, 0.0, 0.0),
    TriedModel("linear", "augmented", "iv", 1.0, "n|n|", 9, note="not tried: time ran out"),
)
COMPARED = Comparison("published structures", "held-out runs", "the fullest within one error", ROWS)


def test_the_best_comes_first_and_what_was_taken_is_marked_with_its_reason():
    assert [r.structure for r in COMPARED.ordered] == ["linear", "thesis", "linear"]
    head, rows = COMPARED.table()
    assert [row[head.index("chosen")] for row in rows] == ["", "chosen", ""]
    assert rows[-1][head.index("score [%]")] == "–"
    assert COMPARED.decision == (
        "iv, augmented, 19 terms: thesis (thrust ~ n) was chosen: the fullest within one error."
    )


def test_a_summary_is_short_and_still_has_what_was_taken():
    lines = COMPARED.lines(1)
    assert len(lines) == 4
    assert lines[1].startswith("    ls")
    assert lines[2].startswith("  > iv")
    assert lines[2].endswith("80.0 %, 0.5 ± 0.8 behind")
    assert "1 more" in lines[3]
    assert "not tried: time ran out" in COMPARED.summary()


def test_json_has_every_alternative():
    data = json.loads(json.dumps(plain(COMPARED.to_dict())))
    assert [r["score"] for r in data["rows"]] == [80.0, 80.5, None]
    assert {"structure", "predictor", "method", "sample_time", "thrust", "terms", "score", "behind",
            "se", "chosen", "note", "integrator", "commands"} == set(data["rows"][0])  # fmt: skip
