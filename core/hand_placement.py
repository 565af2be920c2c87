"""Errors of infrastructure that is laid by hand on a floor: tags, sheets."""

from __future__ import annotations

LAYING_SIGMA_M = 1.5e-3
"""Standard deviation of a position that is measured and marked by hand, along each axis [m]: 1 mm
for the mark and the edge of the sheet, and 1.2 mm for a tape of class II, which is allowed an error
of 0.3 mm + 0.2 mm/m (directive 2014/32/EU, annex X, chapter I), 1.3 mm in 5 m."""

EDGE_SIGMA_M = 1e-3
"""Standard deviation of each end of the edge by which a heading is set [m]."""
