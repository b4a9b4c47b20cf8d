"""Whether to believe an estimate: tests, and one verdict."""

from greybox.estimation.credibility.assess import assess
from greybox.estimation.credibility.convergence import convergence
from greybox.estimation.credibility.evidence import Equation, Evidence
from greybox.estimation.credibility.verdict import weigh

__all__ = ["Equation", "Evidence", "assess", "convergence", "weigh"]
