"""Logs and vessels that several tests share."""

from __future__ import annotations

import gc
import os
import shutil
import time

# two test processes on two cores: threads of BLAS would only wait for each other
for _name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from pathlib import Path

import numpy as np
import pytest
from virtual import PARAMETERS, virtual_log, write_csv

from greybox.model.catalogue import get_structure
from greybox.study.chapter6 import NOMINAL, TRUE
from greybox.trial.readers.limits import Limits
from greybox.vessel.toml import load_vessel


def pytest_collection_finish():
    """Leave out what stays until the end, tests and libraries, whenever garbage is looked for."""
    gc.collect()
    gc.freeze()


def pytest_runtest_setup(item):
    """Leave out the long tests that a slow machine has no time for."""
    until = os.environ.get("LONG_TESTS_UNTIL")
    if until and item.get_closest_marker("long") and time.time() > float(until):
        pytest.skip("no time was left for this long test")


@pytest.fixture
def limited(monkeypatch):
    """Read with other bounds than usual: `limited(values=20)`, the rest as they are."""

    def change(**bounds):
        monkeypatch.setattr("greybox.trial.readers.limits._LIMITS", Limits(**bounds))

    return change


@pytest.fixture
def hasty():
    """Designs by searches of a few evaluations."""
    from designs import hasty_search

    with hasty_search():
        yield


@pytest.fixture
def undrawn(monkeypatch):
    """Pages of empty pictures: of what is read the figures hold nothing."""
    monkeypatch.setattr("matplotlib.figure.Figure.get_layout_engine", lambda self: None)
    monkeypatch.setattr(
        "matplotlib.backends.backend_svg.FigureCanvasSVG.print_svg",
        lambda self, out, **_: out.write("<svg></svg>"),
    )


@pytest.fixture(scope="session")
def thesis():
    return get_structure("thesis")


@pytest.fixture(scope="session")
def ship():
    return load_vessel("thesis")


@pytest.fixture(scope="session")
def true_theta():
    return np.array([TRUE[n] for n in PARAMETERS])


@pytest.fixture(scope="session")
def nominal_theta():
    return np.array([NOMINAL[n] for n in PARAMETERS])


@pytest.fixture(scope="session")
def data_folder():
    folder = Path(os.environ.get("GREYBOX_DATA", "../shared/data"))
    if not folder.is_dir():
        pytest.skip(f"no logs in {folder}: set GREYBOX_DATA")
    return folder


@pytest.fixture(scope="session")
def clean_log():
    """Noise-free, undisturbed."""
    return virtual_log(1, 600, wind=0.0, current=(0.0, 0.0), noise=0.0, spread=0.0)


@pytest.fixture(scope="session")
def noisy_log():
    return virtual_log(2, 5000)


@pytest.fixture(scope="session")
def noisy_file(noisy_log, tmp_path_factory):
    return write_csv(noisy_log.window(0, 2000), tmp_path_factory.mktemp("noisy") / "trial.csv")


@pytest.fixture
def noisy_csv(noisy_file, tmp_path):
    """The first 2000 s of the noisy log, as a file of the test's own."""
    return Path(shutil.copy(noisy_file, tmp_path))
