"""The measurement operator Φ (non-uniform FFT, w-term, spectra) and the SARA dictionary Ψ, with their adjoints.

They act on arrays; neither CASA nor the iteration is known here.
"""
