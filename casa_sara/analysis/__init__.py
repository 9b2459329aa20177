"""Measures, pictures and reports of images that are made: metrics, plots, the HTML report of a run and of a comparison.

Works on arrays and on records; it knows neither CASA nor the solver.
"""
