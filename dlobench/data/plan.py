"""Plans a generation: how long it takes and how much it holds."""

from __future__ import annotations

from collections.abc import Iterable

from dlobench.data.domain_set import DomainSet, Span

# Pushes a second of one core by the number of rigid bodies, DLOs of 16 cm, all materials and attachments; measured
# on a 2.6 GHz Xeon (Sapphire Rapids). `dlobench data plan` measures the machine that it runs on.
RATES = (159.0, 137.0, 120.0, 105.0)


def estimated_hours(of: DomainSet, spans: Iterable[Span]) -> float:
    """Returns the core-hours that generating these spans takes on the machine that `RATES` comes from."""
    seconds = sum(span.count * of.pushes / RATES[of.cell(span.domain).rigid_objects] for span in spans)
    return seconds / 3600
