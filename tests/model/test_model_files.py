"""Model files of every version: written by the schema, read as they were meant."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from schemas import schema

from greybox.errors import ModelFileError
from greybox.model.catalogue import get_structure, structure_names
from greybox.model.model import ManoeuvringModel, load_model, model_from_dict
from greybox.model.predictor import build_predictor
from greybox.model.run.changes import Change
from greybox.model.versions import VERSION, upgraded
from greybox.selection.fit_single import estimate_ls
from greybox.vessel.toml import load_vessel

EARLIER = sorted((Path(__file__).parent / "files").glob("model-*.json"))


def plain_model(name="thesis"):
    structure = get_structure(name)
    size = len(structure.parameters)
    return ManoeuvringModel(
        structure=structure,
        theta=np.linspace(-0.1, 0.1, size),
        covariance=1e-4 * np.eye(size),
        sample_time=0.5,
        vessel=load_vessel("thesis"),
    )


@pytest.mark.parametrize("name", structure_names())
def test_a_model_of_any_structure_is_written_by_the_schema(name):
    data = json.loads(json.dumps(plain_model(name).to_dict()))
    schema(f"model-{VERSION}").validate(data)
    assert data["version"] == VERSION


@pytest.mark.parametrize("vessel", ["thesis", "ferry"])
def test_a_model_with_changes_is_written_by_the_schema_and_read_again(tmp_path, vessel):
    model = replace(
        plain_model(), vessel=load_vessel(vessel), changes=(Change("Xu", 0.5, 100.0),),
        disturbances={"current_north": (0.2, 0.01)},
    )  # fmt: skip
    model.save(tmp_path / "m.json")
    schema(f"model-{VERSION}").validate(json.loads((tmp_path / "m.json").read_text()))
    again = load_model(tmp_path / "m.json")
    assert again.to_dict() == model.to_dict()


def test_an_estimate_is_written_by_the_schema(clean_log):
    estimate = estimate_ls(build_predictor(get_structure("thesis"), "basic"), [clean_log])
    data = json.loads(json.dumps(estimate.model().to_dict()))
    schema(f"model-{VERSION}").validate(data)


@pytest.mark.parametrize("path", EARLIER, ids=lambda p: p.stem)
def test_models_of_earlier_versions_are_read_as_they_were_meant(path, tmp_path):
    data = json.loads(path.read_text())
    schema(f"model-{data['version']}").validate(data)
    model = load_model(path)
    np.testing.assert_array_equal(model.theta, data["theta"])
    np.testing.assert_array_equal(model.covariance, data["covariance"])
    assert list(model.names) == data["names"]
    assert {k: v[0] for k, v in model.disturbances.items()} == {
        k: v["value"] for k, v in data["disturbances"].items()
    }
    assert model.record["fit"] == data["fit"]
    assert (model.noise is None) == (data.get("noise") is None)
    assert [vars(c) for c in model.changes] == data.get("changes", [])
    # written anew it has the present form, and is the same model
    model.save(tmp_path / "now.json")
    now = json.loads((tmp_path / "now.json").read_text())
    schema(f"model-{VERSION}").validate(now)
    assert load_model(tmp_path / "now.json").to_dict() == model.to_dict()


def test_every_earlier_version_has_a_sample_and_a_step():
    seen = {json.loads(p.read_text())["version"] for p in EARLIER}
    assert seen == set(range(1, VERSION))


def test_the_tables_given_are_not_changed():
    data = json.loads(EARLIER[0].read_text())
    before = json.dumps(data)
    upgraded(data, "x")
    assert json.dumps(data) == before


@pytest.mark.parametrize(
    ("version", "message"),
    [
        (VERSION + 1, f"has version {VERSION + 1}, this program reads up to {VERSION}: update"),
        (0, f"has version 0, model files have a whole number from 1 to {VERSION}"),
        (None, "has version None, model files"),
        ("2", "has version '2', model files"),
        (True, "has version True, model files"),
    ],
)
def test_other_versions_are_refused(version, message):
    data = plain_model().to_dict() | {"version": version}
    with pytest.raises(ModelFileError, match=message):
        model_from_dict(data, "m.json")


def test_the_present_version_must_be_whole():
    data = plain_model().to_dict()
    del data["disturbance_covariance"]
    with pytest.raises(ModelFileError, match="damaged model file"):
        model_from_dict(data, "m.json")
    assert not schema(f"model-{VERSION}").is_valid(data)


def test_a_covariance_that_is_not_known_is_none(tmp_path):
    unknown = 1e-4 * np.eye(plain_model().theta.size)
    unknown[0, 0] = np.inf
    replace(plain_model(), covariance=unknown).save(tmp_path / "m.json")
    assert not load_model(tmp_path / "m.json").covariance.any()


def test_a_model_read_again_is_the_same(tmp_path):
    model = replace(plain_model(), disturbances={"current_north": (0.2, 0.01)})
    model.save(tmp_path / "m.json")
    again = load_model(tmp_path / "m.json")
    assert again == model
    assert len({again, model}) == 1
    assert model != replace(model, theta=model.theta + 1e-9)
    assert model != "model"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"integrator": "RK4"}, "integrator 'RK4', which is not known. Did you mean 'rk4'"),
        ({"integrator": 4}, "'integrator' is 4, where a word is needed"),
        ({"sums": {"Xu": [1]}}, "its entry 'sums.Xu.0' is 1, where a word is needed"),
        ({"covariance": [[1.0], [1.0, 2.0]]}, "rows of different lengths"),
        ({"residual_std": {"u": "x"}}, "its entry 'residual_std.u' is 'x', where a number"),
    ],
)
def test_a_damaged_entry_is_named(change, message):
    with pytest.raises(ModelFileError, match=message):
        model_from_dict(plain_model().to_dict() | change, "m.json")
