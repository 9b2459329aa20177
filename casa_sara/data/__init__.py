"""Visibilities as arrays: the rows they come from, their division into snapshot blocks, their noise, their outliers.

Knows neither CASA nor the measurement operator; what is spread over ranks is handled here too.
"""
