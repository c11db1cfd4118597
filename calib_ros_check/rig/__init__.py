"""Are the extrinsics of a rig right, and if not, which sensor is off?"""
