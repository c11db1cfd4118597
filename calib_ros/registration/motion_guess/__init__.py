"""The first guess from motion alone: the LiDAR's odometry against points tracked in the images."""
