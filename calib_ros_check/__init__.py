"""Is an extrinsic right? The test of one recording, or of a fleet."""
