"""How vessels are steered and propelled, and the straight run before a manoeuvre."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from manoeuvring import LENGTH, linear_ship, rudder_model

from greybox.errors import InfeasibleError, UsageError
from greybox.prediction.helm import find_helm
from greybox.prediction.predict import predict_manoeuvre
from greybox.prediction.steady import straight_run
from greybox.vessel.force import generalised_force
from greybox.vessel.toml import load_vessel, vessel_from_dict


def vessel(*thrusters):
    return vessel_from_dict({"name": "V", "length": LENGTH, "thruster": list(thrusters)})


SIDES = [{"type": "fixed", "y": y, "speed": n} for n, y in (("left", -1.0), ("right", 1.0))]
BOW = {"type": "tunnel", "x": 9.0, "speed": "bow", "speed_limits": [-5.0, 5.0]}


@pytest.mark.parametrize(
    ("made", "kind"),
    [
        (load_vessel("ferry"), "azimuth"),
        (load_vessel("thesis"), "azimuth"),
        (vessel(*SIDES), "difference"),
        (vessel({"type": "fixed", "speed": "n"}, BOW), "tunnel"),
        (vessel({"type": "fixed", "speed": "n"}), "none"),
    ],
)
def test_a_positive_order_turns_to_starboard(made, kind):
    """The moment has the sign of the order, and none is left amidships."""
    helm = find_helm(made, limited=False)
    assert helm.kind == kind
    for order in (-0.3, 0.0, 0.3):
        commands = helm.commands(np.array([1.0]), order)
        moment = generalised_force(made, dict(zip(helm.columns, commands, strict=True)))
        if "taun" in moment and kind != "none":
            assert np.sign(np.round(moment["taun"][0], 12)) == np.sign(order)


def test_azimuths_aft_steer_unless_others_are_named():
    ferry = load_vessel("ferry")
    assert find_helm(ferry).steering_columns == ("alpha3", "alpha4")
    assert find_helm(ferry).angle_per_order == 0.5
    assert find_helm(ferry, ("alpha1", "alpha2")).steering_columns == ("alpha1", "alpha2")
    assert "alpha3 and alpha4" in find_helm(ferry).sentence


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("alpha9",), "no command of Ferry. Did you mean 'alpha"),
        (("n1",), "which cannot steer Ferry"),
        (("alpha3", "n1"), "which steer in different ways"),
    ],
)
def test_columns_that_cannot_steer(names, message):
    with pytest.raises(UsageError, match=message):
        find_helm(load_vessel("ferry"), names)


def test_the_command_that_holds_a_speed_is_solved_for():
    """Of linear drag and thrust n: Xmu n = −Xu u."""
    model = linear_ship()
    theta = np.vstack([model.theta, 1.1 * model.theta])
    theta[1, model.names.index("Xmu")] = model.theta[model.names.index("Xmu")]
    made = straight_run(model, find_helm(model.vessel), theta, np.zeros((2, 4)), 0.0, 3.0)
    xu, xmu = (model.theta[model.names.index(n)] for n in ("Xu", "Xmu"))
    np.testing.assert_allclose(made.throttle, [-3 * xu / xmu, -3.3 * xu / xmu], rtol=1e-8)
    np.testing.assert_allclose(made.speed, 3.0)
    assert made.found.all()


def test_a_lopsided_ship_is_trimmed():
    """A constant moment is held by the rudder, and the ship goes straight."""
    model = rudder_model()
    structure = model.structure.with_terms("N_0")
    theta = np.append(model.theta, 2e-5)
    model = replace(model, structure=structure, theta=theta, covariance=np.zeros((len(theta),) * 2))
    made = straight_run(model, find_helm(model.vessel), theta[None], np.zeros((1, 4)), 0.0, 3.0)
    r, n = (model.theta[model.names.index(k)] for k in ("N_|u|u*rudder", "N_0"))
    v, u = made.x[1, 0], made.x[0, 0]
    delta = made.trim[0]
    left = r * u**2 * math.sin(delta) * math.cos(delta) + n
    left += model.theta[model.names.index("Nuv")] * u * v
    assert delta < 0
    assert abs(left) < 1e-9
    assert math.hypot(u, v) == pytest.approx(3.0)
    told = predict_manoeuvre(model, "turning", side="port", speed=3.0, draws=40).summary()
    assert f"a steering order of {math.degrees(-delta):.3g} deg to port" in told


def test_a_speed_out_of_reach_names_the_range():
    model = linear_ship(speed_limits=[0.0, 20.0])
    with pytest.raises(InfeasibleError, match=r"does not hold 9 m/s.* reaches 0 to 4 m/s"):
        predict_manoeuvre(model, "turning", speed=9.0)


def test_limits_that_forbid_to_go_straight():
    model = replace(linear_ship(), vessel=load_vessel("thesis"))
    with pytest.raises(UsageError, match=r"approach needs alpha1 at 0.*from 0\.6 to 1\.1"):
        predict_manoeuvre(model, "turning", command=15.0)
