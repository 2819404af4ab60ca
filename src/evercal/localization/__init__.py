"""From an image to a pose with uncertainty or an honest no; and `teach`, which learns a scene."""
