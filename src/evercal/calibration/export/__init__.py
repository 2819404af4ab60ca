"""Export a calibration to the file formats of other programs: ROS, robot controllers, datasets."""

from evercal.calibration.export.formats import FORMATS as FORMATS
from evercal.calibration.export.formats import export_calibration as export_calibration
