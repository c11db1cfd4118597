"""Training of the image network that calib_ros ships; nothing of it is needed at run time. See README.md in this folder."""
