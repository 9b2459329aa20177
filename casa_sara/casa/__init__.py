"""All that touches CASA's tools and tables: MeasurementSets (`ms`), images (`images`), the process (`runtime`).

Visibilities leave it as arrays (:mod:`casa_sara.data`), images enter it as arrays; nothing here knows the solver.
"""
