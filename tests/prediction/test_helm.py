"""How vessels are steered and propelled, and the straight run before a manoeuvre."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from manoeuvring import LENGTH, linear_ship, model_of, rudder_model

from greybox.errors import InfeasibleError, UsageError
from greybox.model.catalogue import get_structure
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


def twin_screws(**extra):
    """A catamaran of quadratic damping in sway alone, whose limits allow 100 percent."""
    limits = {"speed_limits": [-80.0, 100.0]}
    made = vessel(
        *({"type": "fixed", "x": -8.0, "y": y, "speed": n, **limits}
          for n, y in (("left", -4.0), ("right", 4.0)))
    )  # fmt: skip
    values = {"Xu": -0.2, "Xmu": 0.005, "Nr": -0.4, "Nmu": 0.0003, **extra}
    structure = get_structure("linear").with_terms("Yvv", *(n for n in extra if n != "Yvv"))
    return replace(
        model_of(structure, {"Yvv": -2.0, **values}, made, spread=0.01),
        record={"ranges": {"left": (-20.0, 100.0), "right": (-20.0, 100.0)}},
    )


def test_sway_that_is_damped_by_its_square_alone_is_trimmed():
    """Yvv v|v| + Y_taux taux = 0: at rest the damping has no slope to start from."""
    model = twin_screws(Y_taux=1e-4)
    theta = np.vstack([model.theta, model.theta])
    theta[1, model.names.index("Y_taux")] *= -4
    made = straight_run(model, find_helm(model.vessel), theta, np.zeros((2, 4)), 0.0, 3.0)
    assert made.found.all()
    taux = made.commands.sum(axis=0)
    for k, sign in ((0, 1), (1, -1)):
        force = abs(theta[k, model.names.index("Y_taux")]) * taux[k]
        damping = -theta[k, model.names.index("Yvv")]
        assert made.x[1, k] == pytest.approx(sign * math.sqrt(force / damping), rel=1e-5)


@pytest.mark.parametrize("kind", ["zigzag", "turning", "stopping", "crash"])
def test_the_usual_approach_leaves_room_for_trim_and_steering(kind):
    """Logs with both propellers at their limit: neither more to steer nor to trim is left."""
    model = twin_screws(N_0=0.004)
    made = predict_manoeuvre(model, kind, draws=40)
    speeds = [made.manoeuvres[0].log[n] for n in ("left", "right")]
    assert max(s.max() for s in speeds) <= 100 * (1 + 1e-9)
    before = [s[0] for s in speeds]
    assert abs(before[0] - before[1]) > 1
    assert max(before) == pytest.approx(100 if kind in ("stopping", "crash") else 68, rel=0.02)
    assert "were left out" not in made.summary()


def test_an_approach_that_is_asked_for_is_not_eased():
    model = twin_screws(N_0=0.004)
    with pytest.raises(InfeasibleError, match="within the commands' limits"):
        predict_manoeuvre(model, "stopping", command=100.0, draws=40)
    with pytest.raises(UsageError, match=r"this needs left = 1[0-9.]+, .* a lower --speed"):
        predict_manoeuvre(model, "turning", command=90.0, draws=40)


def test_forces_that_nothing_balances():
    model = twin_screws(Y_taux=1e-4)
    theta = model.theta.copy()
    theta[model.names.index("Yvv")] = 0.0
    with pytest.raises(InfeasibleError, match=r"no commands balance .* at 3 m/s"):
        straight_run(model, find_helm(model.vessel), theta[None], np.zeros((1, 4)), 0.0, 3.0)


def test_a_speed_out_of_reach_names_the_range():
    model = linear_ship(speed_limits=[0.0, 20.0])
    with pytest.raises(InfeasibleError, match=r"does not hold 9 m/s.* reaches 0 to 4 m/s"):
        predict_manoeuvre(model, "turning", speed=9.0)


def test_limits_that_forbid_to_go_straight():
    model = replace(linear_ship(), vessel=load_vessel("thesis"))
    with pytest.raises(UsageError, match=r"approach needs alpha1 at 0.*from 0\.6 to 1\.1"):
        predict_manoeuvre(model, "turning", command=15.0)
