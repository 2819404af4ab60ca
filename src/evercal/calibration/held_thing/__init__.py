"""A fixed camera by a thing that the gripper holds, whose map is in the frame of the gripper."""
