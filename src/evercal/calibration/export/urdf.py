"""URDF: a fixed joint with its `<origin>`.

rpy turns about fixed axes, roll about x first: R = Rz(yaw) Ry(pitch) Rx(roll), in radians (URDF's
specification of `<origin>`).
"""

import re
from xml.sax.saxutils import quoteattr

from evercal.calibration.export.request import Export
from evercal.recordings.poses.conventions import CONVENTIONS, numbers_from_poses


def urdf(export: Export) -> str:
    """A joint to paste into a URDF or xacro that has both links."""
    numbers = (numbers_from_poses(export.pose, CONVENTIONS["rpy"]) + 0.0).tolist()
    xyz, rpy = (" ".join(map(repr, part)) for part in (numbers[:3], numbers[3:]))
    name = re.sub(r"[^\w.-]", "_", f"{export.parent}_to_{export.child}")
    return f"""<joint name={quoteattr(name)} type="fixed">
  <!-- {export.sentence.replace("--", "- -")} -->
  <parent link={quoteattr(export.parent)}/>
  <child link={quoteattr(export.child)}/>
  <origin xyz="{xyz}" rpy="{rpy}"/>
</joint>
"""
