"""`check` of a fixed camera by the arm in a few new images."""

from evercal.calibration.arm_in_view.solve import calibrate_arm_in_view
from evercal.calibration.calibration import Calibration
from evercal.calibration.drift import require_fixed
from evercal.errors import InputError
from evercal.recordings.frame import Recording
from evercal.robot.robot_model import RobotModel


def calibrated_again(
    recording: Recording, model: RobotModel, reference: Calibration
) -> Calibration:
    """Calibrate a camera from its reference on; from nothing, if the images contradict that."""
    require_fixed(reference)
    without = reference.source.get("without", ())
    start = reference.parent_from_child
    try:
        return calibrate_arm_in_view(recording, model, None, without, start)
    except InputError:
        return calibrate_arm_in_view(recording, model, None, without)
