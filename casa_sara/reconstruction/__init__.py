"""From whitened visibilities to a model image: operators, bounds and solver put together, kept and continued; no CASA.

What is read, and what is written at the end, is known elsewhere.
"""
