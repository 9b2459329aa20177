"""The task tsara from data to products: continuum images and cubes, and the forecast of memory and time before them.

Each step is a call into another package; numerics have no place here.
"""
