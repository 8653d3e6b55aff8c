"""A metric of one's own."""

from dreamcatalyst.report.metrics import metric


@metric("rms", title="RMS error", better="lower", identity=0.0, finish=lambda mean: mean.sqrt())
def rms(image, reference):
    """Root mean square error."""
    return (image - reference) ** 2
