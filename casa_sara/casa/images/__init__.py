"""Images on the disk, CASA's and FITS: coordinates, masks, primary beam, restoration, and the products of a run.

Nothing here reads visibilities.
"""
