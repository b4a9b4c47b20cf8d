"""A new estimator is one file: the shell, the library, comparison and choice know it."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
from virtual import virtual_log, write_csv

import greybox as gb
from greybox.commands.main import main
from greybox.errors import UsageError
from greybox.estimation.registry import ESTIMATORS, Estimator
from greybox.estimation.tried import Comparison
from greybox.registry import Registry
from greybox.selection.alternatives import alternatives_for
from greybox.selection.cross_validation import EstimatorVariant, compare_estimators

SMALL = {"structure": "surge", "predictor": "basic"}


@pytest.fixture
def ridge(monkeypatch):
    monkeypatch.syspath_prepend(__file__.rsplit("/", 1)[0])
    from ridge import ENTRY

    ESTIMATORS.add(ENTRY)
    yield ENTRY
    ESTIMATORS.remove(ENTRY.name)


@pytest.fixture(scope="module")
def log():
    return virtual_log(5, 400, spread=0.0)


def test_the_shell_and_the_library_run_a_new_estimator(ridge, log, tmp_path, capsys):
    path = write_csv(log, tmp_path / "trial.csv")
    out, page = tmp_path / "m.json", tmp_path / "m.html"
    words = "--vessel thesis --method ridge --predictor basic --structure surge --out".split()
    assert main(["estimate", str(path), *words, str(out), "--report", str(page)]) == 0
    assert "ridge" in capsys.readouterr().out
    assert "by ridge regression" in page.read_text()
    data = json.loads(out.read_text())
    assert data["method"] == "ridge"
    found = gb.estimate_model(log, method="ridge", **SMALL)
    np.testing.assert_allclose(found.theta, data["theta"])
    assert "it was shrunk; solved." in found.notes
    # biased by noise as least squares is, and smaller in the metric of its information
    plain = gb.estimate_model(log, method="ls", **SMALL)
    assert {t.name for t in plain.tests} <= {t.name for t in found.tests} | {"convergence"}
    inverse = np.linalg.inv(plain.covariance)
    assert found.theta @ inverse @ found.theta < plain.theta @ inverse @ plain.theta


def test_a_new_estimator_is_compared_and_can_be_chosen(ridge, log):
    request = gb.Request(**SMALL)
    tried: list[Comparison] = []
    assert {a.method for a in alternatives_for([log], request, [], tried)} == {"iv", "ls", "ridge"}
    assert "ridge" in {row.method for row in tried[0].rows}
    found = gb.estimate_model(log, method="ls", **SMALL)
    compared = compare_estimators(found, [log], request)
    assert EstimatorVariant("ridge") in compared.variants
    assert np.isfinite(compared.scores[compared.variants.index(EstimatorVariant("ridge"))]).all()
    assert "ridge" in compared.sentence()


def test_it_is_offered_while_it_is_registered(ridge, capsys):
    with pytest.raises(SystemExit):
        main(["estimate", "--help"])
    assert "ridge regression" in capsys.readouterr().out
    with pytest.raises(UsageError, match="there is a method 'ridge' already"):
        ESTIMATORS.add(ridge)


def test_without_it_the_name_is_unknown():
    assert tuple(ESTIMATORS) == ("ls", "iv", "oe")
    with pytest.raises(UsageError, match=r"there is no method 'rigde'. Known: ls, iv, oe\."):
        ESTIMATORS["rigde"]


def test_another_distribution_adds_its_own(tmp_path, monkeypatch):
    """By an entry point, found when names are first asked for."""
    (tmp_path / "total.py").write_text(
        "from greybox.estimation.registry import Estimator\n"
        "ENTRY = Estimator('tls', 'total least squares', lambda problem: None)\n"
    )
    folder = tmp_path / "total-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: total\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text("[greybox.estimators]\ntls = total:ENTRY\n")
    monkeypatch.syspath_prepend(tmp_path)
    fresh: Registry[Estimator] = Registry(
        "method", package="greybox.estimation.estimators", group="greybox.estimators"
    )
    assert tuple(fresh) == ("ls", "iv", "oe", "tls")
    assert fresh["tls"].words == "total least squares"
    sys.modules.pop("total", None)
