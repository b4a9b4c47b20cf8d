"""The promised names, and how they refuse what they do not know."""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path

import pytest
from virtual import virtual_log

import experiment_design as ed
import greybox as gb
from greybox.errors import GreyboxError, UsageError


@pytest.mark.parametrize("package", [gb, ed])
def test_type_checkers_and_programs_see_the_same_names(package):
    tree = ast.parse(Path(package.__file__).with_suffix(".pyi").read_text())
    stub = {a.asname: (n.module, a.name) for n in tree.body[0:] for a in n.names}
    assert sorted(stub) == sorted(package.__all__) == dir(package)
    for name, (module, there) in stub.items():
        assert name == there
        assert getattr(package, name) is getattr(import_module(module), name)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        package.nothing


@pytest.mark.parametrize(
    ("keywords", "told"),
    [
        ({"metod": "ls"}, "no keyword 'metod'. Did you mean 'method'?"),
        ({"method": "2sls"}, "'2sls' is no method. Did you mean 'ls'? It is one of ls, iv"),
        ({"method": "IV"}, "'IV' is no method. Did you mean 'iv'?"),
        ({"predictor": "augmentd"}, "Did you mean 'augmented'?"),
        ({"covariance": "robust"}, "'robust' is no covariance."),
        ({"loop": "close"}, "Did you mean 'closed'?"),
        ({"method": "refined-iv", "prefilter": "none"}, "use method 'iv'"),
        ({"request": gb.Request(), "method": "ls"}, "give all of them in one of the two ways"),
    ],
)
def test_what_is_unknown_is_refused_in_one_sentence(keywords, told):
    with pytest.raises(UsageError) as error:
        gb.estimate_model(virtual_log(3, 20), **keywords)
    assert told in str(error.value)


def test_an_unknown_keyword_is_a_type_error_too():
    with pytest.raises(TypeError, match=r"has no keyword 'band'\. Did you mean 'bands'"):
        gb.compare({}, [], band=False)


def test_one_log_needs_no_list_and_old_calls_still_work():
    log = virtual_log(3, 300)
    asked = {"method": "ls", "predictor": "basic", "structure": "linear"}
    estimate = gb.estimate_model(log, **asked)
    with pytest.warns(DeprecationWarning, match="estimate_model\\(logs, method=…\\)") as told:
        before = gb.estimate_model([log], gb.Request(**asked))
    assert told[0].filename == __file__
    assert before.summary() == estimate.summary()
    both = gb.compare({"a": estimate, "b": estimate.model()}, log, bands=False)
    with pytest.warns(DeprecationWarning, match="compare\\({name: model}, logs\\)"):
        old = gb.compare_models([estimate.model()], ["a"], [[log]], bands=False)
    assert both.runs[0][0].fit == both.runs[1][0].fit == old.runs[0][0].fit
    for logs in (log, [log], [[log], [log]]):
        with (
            pytest.warns(DeprecationWarning, match="compare_models"),
            pytest.raises(UsageError, match=r"list of its own: write compare\({name: model}, logs"),
        ):
            gb.compare_models([estimate.model()], ["a"], logs, bands=False)
    by_name = gb.compare({"a": estimate}, {"a": [log], "c": []}, bands=False)
    assert by_name.names == ("a",)
    with pytest.raises(GreyboxError, match=r"the logs have no 'ab'\. Did you mean 'a'"):
        gb.compare({"ab": estimate}, {"a": log})
    with pytest.raises(GreyboxError, match="0 logs are given"):
        gb.compare({"a": estimate}, [])


def test_refined_instruments_by_name():
    asked = gb.Request(method="refined-iv")
    assert (asked.method, asked.prefilter) == ("iv", "noise")


def test_estimators_take_one_log_too():
    log = virtual_log(3, 300)
    predictor = gb.build_predictor(gb.get_structure("linear"), "basic")
    for estimator in (gb.estimate_ls, gb.estimate_iv):
        one = estimator(predictor, log, judged=False)
        assert one.params.equals(estimator(predictor, [log], judged=False).params)
        with pytest.raises(UsageError, match="Did you mean 'judged'"):
            estimator(predictor, log, judge=False)


@pytest.mark.parametrize("logs", [[], "trial.csv", ["trial.csv"], None, {"t": [0.0, 1.0]}])
def test_what_is_no_log_is_refused_in_one_sentence(logs):
    for use in (gb.estimate_model, gb.diagnose, lambda x: gb.compare({"a": gb.Vessel}, x)):
        with pytest.raises(GreyboxError, match=r"is no log: read one|0 logs are given|have no 'a'"):
            use(logs)
