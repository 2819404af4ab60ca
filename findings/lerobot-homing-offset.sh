#!/usr/bin/env bash
# lerobot 0.4.4: a larger homing_offset in the calibration file lowers the degrees of a Feetech motor
# (SO-100, SO-101) and raises those of a Dynamixel (Koch), and the file does not say which one it is
# for. A degree is 4095/360 ticks, though the motor has 4096 a turn. Shifting homing_offset together
# with range_min and range_max, as if they were one zero, leaves the degrees as they were. On Feetech,
# an offset of 2048 ticks is refused when it is written, not when the file is read.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-deps --no-warn-conflicts lerobot==0.4.4 feetech-servo-sdk==1.0.0 \
    dynamixel-sdk==4.1.0 draccus==0.10.0
"$folder/venv/bin/pip" install --quiet --no-warn-conflicts pyserial==3.5 deepdiff==8.6.1 tqdm==4.67.1 \
    mergedeep==1.3.4 pyyaml==6.0.3 pyyaml-include==1.4.1 toml==0.10.2 typing-inspect==0.9.0
"$folder/venv/bin/python" - <<'PYTHON'
import json
import sys
import types
from importlib.metadata import version

# The only part of lerobot's `utils` that the motors use waits for a key; the module needs torch.
utils = types.ModuleType("lerobot.utils.utils")
utils.enter_pressed = utils.move_cursor_up = lambda *_: None
sys.modules["lerobot.utils.utils"] = utils

import draccus
from lerobot.motors.dynamixel import DynamixelMotorsBus
from lerobot.motors.feetech import FeetechMotorsBus
from lerobot.motors.motors_bus import Motor, MotorCalibration, MotorNormMode, get_address

print("lerobot", version("lerobot"))


class Memory:
    """The registers of one motor, whose encoder stands at a tick."""

    def __init__(self, bus, sign, encoder):
        self.bus, self.sign, self.encoder, self.values = bus, sign, encoder, {}

    def write(self, address, length, motor, value, **_):
        self.values[address] = value
        return 0, 0

    def read(self, address, length, motor, **_):
        def where(name):
            return get_address(self.bus.model_ctrl_table, self.bus.motors["elbow"].model, name)[0]

        if address != where("Present_Position"):
            return self.values[address], 0, 0
        stored = self.values[where("Homing_Offset")]
        offset = self.bus._decode_sign("Homing_Offset", {1: stored})[1]
        present = self.encoder + self.sign * offset
        return self.bus._encode_sign("Present_Position", {1: present})[1], 0, 0


def degrees(kind, model, sign, row, encoder):
    """What lerobot reads after it has written the calibration into the motor."""
    # The file is written and read by lerobot's own way.
    file = draccus.encode({"elbow": MotorCalibration(**row)})
    calibration = draccus.decode(dict[str, MotorCalibration], json.loads(json.dumps(file)))
    bus = kind("/dev/null", {"elbow": Motor(1, model, MotorNormMode.DEGREES)}, calibration)
    memory = Memory(bus, sign, encoder)
    bus._write, bus._read = memory.write, memory.read
    bus.port_handler.is_open = True
    bus.write_calibration(calibration)
    return bus.read("Present_Position", "elbow")


FEETECH = FeetechMotorsBus, "sts3215", -1
DYNAMIXEL = DynamixelMotorsBus, "xl430-w250", 1
row = {"id": 1, "drive_mode": 0, "homing_offset": 120, "range_min": 800, "range_max": 3100}
for name, kind in {"feetech": FEETECH, "dynamixel": DYNAMIXEL}.items():
    at = degrees(*kind, row, 2300)
    more = degrees(*kind, {**row, "homing_offset": 131}, 2300)
    print(f"{name:9} {at:.4f} deg; with 11 ticks more {more - at:+.4f} deg")
    assert abs(more - at - kind[2] * 11 * 360 / 4095) < 1e-9
    shift = kind[2] * 11
    both = {**row, "homing_offset": 131, "range_min": 800 + shift, "range_max": 3100 + shift}
    assert degrees(*kind, both, 2300) == at
try:
    degrees(*FEETECH, {**row, "homing_offset": 2048}, 2300)
except ValueError as error:
    print("feetech  ", error)
else:
    raise AssertionError("2048 is written now")
PYTHON
