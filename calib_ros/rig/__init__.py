"""Several cameras and LiDARs: the graph of their extrinsics, one answer for the whole rig, and which sensor moved."""
