"""Everything that uses CASA's tools: reading data, weights, writing images and the model column."""
