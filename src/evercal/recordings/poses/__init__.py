"""Robot poses: tables, conventions, joint angles, pairing with images."""
