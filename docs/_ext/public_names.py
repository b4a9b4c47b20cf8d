"""Directive ``public STEP``: the reference of the public names that belong to one step.

Names that no step claims stand under ``further``, so that none is left out.
"""

from __future__ import annotations

import inspect
import re
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import experiment_design
import greybox

STEPS = {
    "log": "Vessel load_vessel vessel_from_dict TrialLog make_log read_log read_segments decimate "
    "write_log",
    "check": "read_recording Recording import_files import_recording ImportOptions check_files "
    "check_recording check_recordings CheckReport Finding repair describe_recording "
    "find_manoeuvres",
    "model": "get_structure structure_names Structure build_predictor output_predictor Predictor "
    "ManoeuvringModel load_model simulate stationary_disturbance",
    "estimate": "estimate_model Request estimate_ls estimate_iv estimate_refined_iv estimate_oe "
    "OutputErrorOptions Estimate Verdict TrustLevel PredictionVerdict PredictionLevel TestResult",
    "compare": "run_model compare Comparison compare_models fit_percent",
    "diagnose": "diagnose DiagnosisOptions Diagnosis fit_given Given known_causes Cause",
    "design": "prepare_request DesignRequest TrialLimits Circle PreparedRequest build_problem "
    "noise_levels NoiseLevels design_trial Design write_plan certify Certificate predict_precision "
    "PredictedPrecision design_between CandidateModel Discrimination least_duration prbs "
    "random_two_level to_log",
}
_PACKAGES = (greybox, experiment_design)


def public_names() -> dict[str, str]:
    """Return every public name and the package that promises it."""
    return {n: p.__name__ for p in _PACKAGES for n in p.__all__}


def names_of(step: str) -> list[str]:
    """Return the names of one step; of ``further``, those that no other has."""
    if step != "further":
        return STEPS[step].split()
    claimed = {n for names in STEPS.values() for n in names.split()}
    return [n for n in public_names() if n not in claimed]


class Public(SphinxDirective):
    """The reference of one step."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return what autodoc makes of each name."""
        lines: list[str] = []
        for name in names_of(self.arguments[0]):
            package = public_names()[name]
            value = getattr(greybox if package == "greybox" else experiment_design, name)
            kind = "class" if inspect.isclass(value) else "function" if callable(value) else "data"
            lines += [f".. auto{kind}:: {package}.{name}", ""]
            if kind == "class":
                lines[-1:] = ["   :members:", ""]
        if not lines:
            lines = ["None at present."]
        return self.parse_text_to_nodes("\n".join(lines), allow_section_headings=False)


class PublicErrors(SphinxDirective):
    """The errors that a user can meet."""

    def run(self) -> list[nodes.Node]:
        """Return the reference of each error."""
        from greybox import errors

        known = [errors.GreyboxError, *errors.GreyboxError.__subclasses__()]
        text = "\n\n".join(f".. autoclass:: greybox.errors.{e.__name__}" for e in known)
        return self.parse_text_to_nodes(text, allow_section_headings=False)


def escape(app: Sphinx, what: str, name: str, item: Any, options: Any, lines: list[str]) -> None:
    """Let a modulus |u| and a shape (p, *S) be read as they are written."""
    for i, line in enumerate(lines):
        parts = line.split("``")
        parts[::2] = [re.sub(r"(\||\*(?=[A-Z]\b))", r"\\\1", p) for p in parts[::2]]
        lines[i] = "``".join(parts)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directives."""
    app.add_directive("public", Public)
    app.add_directive("public-errors", PublicErrors)
    # before numpydoc takes the sections apart
    app.connect("autodoc-process-docstring", escape, priority=100)
    return {"parallel_read_safe": True}
