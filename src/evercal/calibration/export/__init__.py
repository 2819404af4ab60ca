"""Export a calibration to the file formats of other programs: ROS, robot controllers, datasets."""
