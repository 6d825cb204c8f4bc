"""What speaks against a block from which something further is computed: draws, halves, sensitivities."""

from jaxphoto.adjustment import Adjustment
from jaxphoto.cli.output import Output
from jaxphoto.report import Tables, Verdict
from jaxphoto.report.residual_findings import contradictions


def print_judgement(adjusted: Adjustment, output: Output) -> None:
    """The worst that `jaxphoto adjust` would say of the observations of a block; nothing where they agree."""
    if not bool(adjusted.converged):
        against = [adjusted.outcome.value]
    else:
        verdict = Verdict.of(contradictions(Tables(adjusted)))
        against = [f.text for f in verdict.findings if f.severity != "note"]
    if against:
        output.warn(f"the block itself: {against[0]} (jaxphoto adjust says more)")
