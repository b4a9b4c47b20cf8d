"""Standard manoeuvres found in a log and measured, each value with its interval."""

from greybox.trial.manoeuvres.finding import Manoeuvre, find_manoeuvres
from greybox.trial.manoeuvres.quantity import Quantity
from greybox.trial.manoeuvres.standards import Compliance, Criterion
from greybox.trial.manoeuvres.steering import held_angles, steering_angle
from greybox.trial.manoeuvres.stopping import Stopping, measure_stopping
from greybox.trial.manoeuvres.turning_circle import TurningCircle, measure_turning_circle
from greybox.trial.manoeuvres.zig_zag import ZigZag, measure_zigzag, without_angle

__all__ = [
    "Compliance",
    "Criterion",
    "Manoeuvre",
    "Quantity",
    "Stopping",
    "TurningCircle",
    "ZigZag",
    "find_manoeuvres",
    "held_angles",
    "measure_stopping",
    "measure_turning_circle",
    "measure_zigzag",
    "steering_angle",
    "without_angle",
]
