"""A first guess of the extrinsic from classes of pixels and points alone (thesis 3.5)."""
