"""A camera by the map of a room: fixed, on the gripper, or with the map's own pose in the base."""
