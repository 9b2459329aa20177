"""All that talks to CASA's tools: data in, weights, images and model column out."""
