"""The process and its machine: memory, cores, signals, time limits, compiled kernels, atomically written files.

Nothing of radio astronomy.
"""
