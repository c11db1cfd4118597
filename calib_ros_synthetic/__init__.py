"""The synthetic drive: a ray-cast street with exact ground truth (`drive.SyntheticDrive`)."""
