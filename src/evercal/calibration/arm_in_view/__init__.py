"""A fixed camera calibrated by the robot arm in its images: joint values, a URDF, no start."""
