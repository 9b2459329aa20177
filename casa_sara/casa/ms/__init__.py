"""MeasurementSets: data selection, reading, frames, imaging weights and sampling density, the model column.

Knows nothing of images on the disk.
"""
