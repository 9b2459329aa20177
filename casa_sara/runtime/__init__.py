"""The process and its machine: memory, cores, signals, time limits, compiled kernels, files that are written atomically.

Nothing of radio astronomy.
"""
