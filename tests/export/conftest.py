"""The model that exports are made of."""

import numpy as np
import pytest

from greybox.model.model import ManoeuvringModel


@pytest.fixture(scope="module")
def model(thesis, ship, true_theta):
    return ManoeuvringModel(thesis, true_theta, np.zeros((18, 18)), 1.0, ship)
