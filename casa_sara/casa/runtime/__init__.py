"""CASA's process: its log, its tools, quantities with units, the lock of a run, the child process that writes.

Knows neither MeasurementSets nor images.
"""
