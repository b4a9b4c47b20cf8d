"""Every threshold of a diagnosis: what it stands for, and the run that set it.

Those of the numerics (steps, iterations, scales) stand beside the code that they serve.
"Blind" are the virtual trials of ``greybox.study.blind``, "foreign" ships whose simulators share
no equation with the model.
"""

from __future__ import annotations

# -- a cause is significant, matters, and predicts (search) -----------------------------------
# significance of a cause after correction for all that were tried (Holm): blind, 5 % false alarms
# of the whole search
SIGNIFICANT = 0.01
# significance of what it does beside a generic force
PROVEN = 0.05
# significance of what it does for held-out logs, and beside a generic force where errors are
# weighed by their size alone: one standard error, as terms are chosen, since few samples of errors
# with a long memory are independent. Foreign ships, real tanker: a lag of 28 % of the error had
# p = 0.08; blind, 30 of 30 without an effect stayed without a cause
AS_CHOSEN = 0.16
# fall of −2 log L a measured number from which on a cause matters: blind, |r|r for r³ gained 0.1 %
RELEVANT = 0.005
# share of what the absence of a cause costs below which a step of the fit without it decides
# nothing, where that fit found no minimum at first: it would hardly end by itself
DECIDED = 1e-3
# causes at most: a fifth has never been right
MOST_CAUSES = 4
# price of a thrust coefficient below zero, in numbers: exchanged columns pass for each other
BACKWARDS = 3

# -- a cause stands beside a force without a name (standing) -----------------------------------
# share of what a generic force of the cause's own arguments gains that the cause must take, with
# fewer numbers, and the share that the 95 % interval must lie above
OWN_SHARE, LEAST_SHARE = 0.8, 0.5
# significance of a hull's term whose movement beside that force counts as a standard error: one
# standard error. Foreign ships in wind: at 5 % a true coupling fell at 0.053, and with it the wind.
# Of other numbers `PROVEN` is asked: real tankers in a pond and a basin, where at one standard
# error a current stood, and a foreign tanker as it is, where an angle of 0.7 ± 0.4 degrees did
SAME = 0.32

# standard error of a clock that only forces tell of, as a share of the time in which the ship sails
# her length: the root mean square of shifts by forces without a term, 0.05 and 0.08 on a foreign
# container ship, 0.13 and 0.17 on two simulators whose sway and yaw are damped by u v and u r
PHASE = 0.12

# -- causes do equally well (confusion) --------------------------------------------------------
# probability with which chance makes rivals differ so much on held-out logs
CHANCE = 0.05
# difference of −2 log L on all logs that decides by itself, whatever its standard error
DECISIVE = 12.0

# -- what is left (ruling) ---------------------------------------------------------------------
# significance of what any force could still explain
SURE = 0.005
# share of the squared error below which a deviation is told and overturns nothing
WORTH = 0.01
# share of what the causes explain that may be left over, for the model's own simplicity
LEFT_OVER = 0.1
# significance of other coefficients on the held-out logs, and the share of the causes' gain
# that fitting them there may bring beside: gusts make single logs differ more than this
APART, BESIDE = 1e-4, 0.25
# mean squared error, in the sensors' variances, that is worth a word, and the share of what
# was there that causes may leave
LARGE, MOST_OF = 0.3, 0.35
# seconds for which gusts are remembered at most, and the fall of −2 log L of all logs, and of
# each, by a longer memory from which on what moves the ship is no gust
GUST, LONGER, EACH = 30.0, 18.0, 4.0
# free-run error of held-out logs, in the sensors' deviations, up to which nothing is wrong: blind,
# gusts that nobody measured make it 4 to 15; and from which on a run must beat a constant
SENSORS, NEAR = 20.0, 3.0
